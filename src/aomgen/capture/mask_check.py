"""Whether the label images of a scan can be used: readable, of its size and names, with known labels."""

from pathlib import Path

import numpy as np

from aomgen.conventions import MOVING, PART_LABELS, STATIC
from aomgen.core.recording import Capture, frame_name
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.images import read_labels


def check_masks(capture: Capture) -> list[str]:
    """Read every label image of the scan; warnings.

    Raises:
        MalformedFileError: One cannot be read, has another size than the scan, or no image of a
            folder labels the object.
        MissingFileError: The label images of a folder are named like no scan image.
    """
    unlabelled = {prompt.image for prompt in capture.prompts if prompt.part != "robot"}
    for folder in capture.mask_folders.values():
        files = sorted(folder.glob("*.png"))
        _check_names(capture, folder, files)
        _check_labels(capture, folder, files)
        stems = {path.stem for path in files}
        unlabelled = {name for name in unlabelled if Path(name).stem not in stems}
    if not capture.mask_folders or not unlabelled:
        return []
    return [
        f"{capture.folder / 'masks'}: no label image for {', '.join(sorted(unlabelled))}, which prompts name: "
        "their masks will be empty"
    ]


def _check_names(capture: Capture, folder: Path, files: list[Path]) -> None:
    stems = {path.stem for path in capture.scan_images}
    names = f"{min(stems)}.png" if stems else Path(frame_name(0)).name
    known = [path for path in files if path.stem in stems or capture.scan_video is not None]
    if not known:
        raise MissingFileError(
            folder,
            f"holds {len(files)} PNG files, none named like a scan image",
            f"name them as the images, {names} for example, or remove the folder",
        )


def _check_labels(capture: Capture, folder: Path, files: list[Path]) -> None:
    found: set[int] = set()
    for path in files:
        labels = read_labels(path)
        if not labels.shape[::-1] == capture.scan_size:
            raise MalformedFileError(
                path, f"is {labels.shape[::-1]} px, its image is {capture.scan_size}", "export it again"
            )
        found |= set(np.unique(labels).tolist())
    if not found & {STATIC, MOVING}:
        wanted = ", ".join(f"{value} {name}" for name, value in PART_LABELS.items())
        raise MalformedFileError(
            folder, f"has the labels {', '.join(map(str, sorted(found)))} only", f"want {wanted}"
        )
