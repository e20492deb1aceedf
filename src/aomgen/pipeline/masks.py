"""Compute label images of a whole scan from prompts on a few of its images (`aomgen masks`)."""

from pathlib import Path

from aomgen.capture.read import read_capture
from aomgen.core.progress import Progress
from aomgen.errors import ConfigError, InputError
from aomgen.io.atomic import stage_folder, write_bytes
from aomgen.io.images import encode_png, read_image
from aomgen.segmentation.sam2 import carry_prompts, load_tracker
from aomgen.segmentation.sam2_weights import find_sam2

FOLDER = "masks"


def write_masks(capture_folder: Path, weights: str, progress: Progress) -> Path:
    """Track the prompted parts through a scan with SAM 2, write label images, and return their folder.

    A later run of the capture uses these masks. The alphabetical order of the image names must be the order in which the
    images were taken.

    Args:
        capture_folder: Folder of the capture; the label images are written to `masks/<weights>/*.png` in it.
        weights: Name of the SAM 2 weights.
        progress: Receives the progress.

    Raises:
        InputError: The scan is a video, or no prompt is on one of its images.
        ConfigError: Masks of these weights exist already.
        BackendError: See `sam2.load_tracker`.
    """
    capture = read_capture(capture_folder)
    target = capture.folder / FOLDER / weights
    if capture.scan_video is not None:
        raise InputError(capture.scan_video, "is a video", "give the scan as a folder of images")
    if target.exists():
        raise ConfigError(target, "exists already", "delete it to compute the masks again")
    tracker = load_tracker(find_sam2(weights))
    images = {path.name: path for path in capture.scan_images}
    with stage_folder(target) as staging:
        carried = carry_prompts(
            tracker, sorted(images), lambda name: read_image(images[name]), capture.prompts, progress
        )
        for name, labels in carried:
            write_bytes(staging / f"{Path(name).stem}.png", encode_png(labels))
    return target
