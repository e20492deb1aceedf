"""Label images that a segmenter made: of scan images, and of the frames of a demonstration video."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, PART_LABELS, STATIC
from aomgen.core.lens import undistort_labels
from aomgen.core.recording import DemoCamera, Recording, frame_name
from aomgen.errors import IncompleteCaptureError, MalformedFileError, MissingFileError
from aomgen.io.images import read_labels

# In the folder of the videos: `masks/` belongs to the scan, whose images have the same names.
FOLDER = Path("demo") / "masks"


def demo_mask_files(capture: Recording, camera: DemoCamera) -> list[Path]:
    """List `demo/masks/<camera>/*.png`, one for each frame in the order of names; empty without any."""
    return sorted((capture.folder / FOLDER / camera.name).glob("*.png"))


def read_demo_masks(
    capture: Recording, camera: DemoCamera, shape: tuple[int, int, int]
) -> NDArray[np.uint8] | None:
    """Read the labels (T, H, W) of the frames that `read_demo_videos` returns, undistorted; None without any.

    Args:
        shape: Frames, height and width of that video.

    Raises:
        IncompleteCaptureError: The number of label images differs from the number of video frames.
        MalformedFileError: One has another size than the video.
    """
    files = demo_mask_files(capture, camera)
    if not files:
        return None
    count, height, width = shape
    if not len(files) == count:
        raise IncompleteCaptureError(
            files[0].parent,
            f"has {len(files)} label images, the video {count} frames",
            "write one label image for each frame",
        )
    labels = np.empty(shape, np.uint8)
    for k, path in enumerate(files):
        image = read_labels(path)
        if not image.shape == (height, width):
            raise MalformedFileError(
                path, f"is {image.shape[::-1]} px, the video {(width, height)}", "export it again"
            )
        labels[k] = image if camera.lens is None else undistort_labels(image, camera.lens)
    return labels


def check_masks(capture: Recording) -> list[str]:
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


def _check_names(capture: Recording, folder: Path, files: list[Path]) -> None:
    stems = {path.stem for path in capture.scan_images}
    names = f"{min(stems)}.png" if stems else Path(frame_name(0)).name
    known = [path for path in files if path.stem in stems or capture.scan_video is not None]
    if not known:
        raise MissingFileError(
            folder,
            f"contains {len(files)} PNG files, but none has the name of a scan image",
            f"name them like the images, for example {names}, or remove the folder",
        )


def _check_labels(capture: Recording, folder: Path, files: list[Path]) -> None:
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
            folder, f"has the labels {', '.join(map(str, sorted(found)))} only", f"expected {wanted}"
        )
