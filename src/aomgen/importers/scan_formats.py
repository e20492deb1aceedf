"""Recognition of a scan's format from its content."""

from pathlib import Path
from typing import Final

from aomgen.core.progress import Progress
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.importers.colmap_scan import find_model, read_colmap_scan
from aomgen.importers.photos import read_photos
from aomgen.importers.polycam import find_keyframes, read_polycam
from aomgen.importers.record3d import find_metadata, read_record3d
from aomgen.importers.scan_source import ScanImage, ScanSource
from aomgen.importers.transforms_json import TRANSFORMS_FILE, read_transforms
from aomgen.structure.video_frames import extract_frames

FORMATS: Final = (
    "a folder of photos, a video, a COLMAP model, transforms.json, or an export of Polycam or Record3D"
)


def read_scan_source(source: Path, scratch: Path, progress: Progress) -> ScanSource:
    """Read a scan of any known format.

    Args:
        source: A folder, a video, or a `transforms.json`.
        scratch: Folder for the frames of a video.

    Raises:
        MissingFileError: The file or folder does not exist.
        InputError: The scan is not usable; see the readers of the formats.
    """
    if not source.exists():
        raise MissingFileError(source, "is missing", f"give {FORMATS}")
    if source.is_file():
        if source.suffix.lower() == ".json":
            return read_transforms(source)
        if source.suffix.lower() in (".jpg", ".jpeg", ".png", ".heic", ".txt", ".bin"):
            raise MalformedFileError(source, "is one file of a scan", "give the folder that holds all of it")
        return _read_video(source, scratch, progress)
    # If a folder matches several formats, the format with the most information is read.
    if find_keyframes(source):
        return read_polycam(source)
    if (source / TRANSFORMS_FILE).is_file():
        return read_transforms(source / TRANSFORMS_FILE)
    if find_model(source):
        return read_colmap_scan(source)
    if find_metadata(source):
        return read_record3d(source)
    return read_photos(source)


def _read_video(source: Path, scratch: Path, progress: Progress) -> ScanSource:
    """Sample sharp frames with new content, as for the scan video of a capture."""
    frames = extract_frames(source, set(), scratch, progress)
    images = tuple(ScanImage(name=f"{path.stem}.jpg", path=path) for path in frames.values())
    return ScanSource(kind="video", images=images)
