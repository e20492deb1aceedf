"""Import of a scan into a capture: images, poses and the `[scan]` table of capture.toml."""

import tempfile
from pathlib import Path
from typing import Final

from aomgen.capture.manifest_text import read_manifest_text
from aomgen.core.progress import Progress, part
from aomgen.core.recording import CAPTURE_FILE
from aomgen.errors import ConfigError, IncompleteCaptureError
from aomgen.importers.scan_formats import read_scan_source
from aomgen.importers.scan_table import change_scan_table
from aomgen.importers.scan_writing import WrittenScan, write_scan
from aomgen.io.atomic import stage_folder, write_text

SCAN_FOLDER: Final = "scan"
# Smallest number of images: with fewer, some sides of the object are seen by less than three views.
MIN_IMAGES: Final = 12


def import_scan(
    source: Path, capture: Path, long_side: int, progress: Progress
) -> tuple[str, WrittenScan, bool]:
    """Write a scan of another program into the folder `scan` of a capture, and describe it in capture.toml.

    Nothing is written unless every image can be decoded. Only the keys of `[scan]` in capture.toml are changed; other
    lines and comments are kept.

    Args:
        source: See `read_scan_source`.
        capture: Folder of the capture, which is created if it does not exist.
        long_side: See `write_scan`.

    Returns:
        Name of the format, the written images, and whether capture.toml lacks the table [robot], as a new file does.

    Raises:
        ConfigError: The capture already has a scan, or its capture.toml cannot be changed line by line.
        InputError: The source is invalid.
        StorageError: Writing to the disk failed.
    """
    folder, file = capture / SCAN_FOLDER, capture / CAPTURE_FILE
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ConfigError(folder, "exists already", "move it away")
    text = read_manifest_text(file) if file.is_file() else "format = 1\n"
    new = not capture.exists()
    with tempfile.TemporaryDirectory() as scratch:
        found = read_scan_source(source, Path(scratch), part(progress, 0.0, 0.5))
        if len(found.images) < MIN_IMAGES:
            raise IncompleteCaptureError(
                source, f"holds {len(found.images)} images, at least {MIN_IMAGES} are needed", "take more"
            )
        with stage_folder(capture if new else folder) as staging:
            scan = staging / SCAN_FOLDER if new else staging
            scan.mkdir(exist_ok=True)
            written = write_scan(found, scan, long_side, source, part(progress, 0.5, 1.0))
            changed = change_scan_table(text, SCAN_FOLDER, written.intrinsics, file)
            if new:
                write_text(staging / CAPTURE_FILE, changed)
    if not new:
        write_text(file, changed)
    return found.kind, written, "[robot]" not in text
