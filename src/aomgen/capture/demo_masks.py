"""Label images of a demonstration video, where a segmenter has made some."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.lens import undistort_labels
from aomgen.core.recording import Capture, DemoCamera
from aomgen.errors import IncompleteCaptureError, MalformedFileError
from aomgen.io.images import read_labels

# Beside the videos: `masks/` belongs to the scan, whose images have the same names.
FOLDER = Path("demo") / "masks"


def demo_mask_files(capture: Capture, camera: DemoCamera) -> list[Path]:
    """`demo/masks/<camera>/*.png`, one a frame in the order of names; none when nobody made any."""
    return sorted((capture.folder / FOLDER / camera.name).glob("*.png"))


def read_demo_masks(
    capture: Capture, camera: DemoCamera, shape: tuple[int, int, int]
) -> NDArray[np.uint8] | None:
    """Labels (T, H, W) of every frame as `read_demo_videos` gives them, undistorted; None without any.

    Args:
        capture: Holds them.
        camera: Whose video.
        shape: Frames, height and width of that video.

    Raises:
        IncompleteCaptureError: There are label images, but not one a frame.
        MalformedFileError: One has another size than the video.
    """
    files = demo_mask_files(capture, camera)
    if not files:
        return None
    count, height, width = shape
    if not len(files) == count:
        raise IncompleteCaptureError(
            files[0].parent, f"has {len(files)} label images, the video {count} frames", "make one a frame"
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
