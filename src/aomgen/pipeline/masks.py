"""`aomgen masks`: label images of a whole scan from the prompts on a few of its images."""

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
    """Follow the prompted parts through the scan with SAM 2 and write `masks/<weights>/*.png`; that folder.

    A later run of the capture takes its masks from there. The images have to lie in the order in
    which they were taken, as their names say.

    Raises:
        InputError: The scan is a video, or no prompt is on one of its images.
        ConfigError: Masks of these weights are there already.
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
