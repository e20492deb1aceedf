"""Scores of renderings of a finished run's twin against the capture's own images and true masks."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.lens import Lens, undistort_labels
from aomgen.core.recording import Recording
from aomgen.io.images import read_image, read_labels
from aomgen.io.video import Video
from aomgen.splatting.metrics import psnr, ssim
from aomgen.twin.twin import TwinState

ROBOT_MARGIN_PX = 8
PARTS = {"robot": ROBOT, "static": STATIC, "moving": MOVING}

# Image (H, W, 3) uint8 and labels (H, W) uint8 of the twin from a camera in a state.
RenderTwin = Callable[[Camera, TwinState], tuple[NDArray[np.uint8], NDArray[np.uint8]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueMasks:
    """True labels of one camera's images.

    Attributes:
        folder: `truth/masks/<camera>`, masks of the images as photographed.
        lens: Lens of those images; None without distortion. The product's images are undistorted.
    """

    folder: Path
    lens: Lens | None = None

    def has(self, stem: str) -> bool:
        """Return whether there is a mask of this image; a scan video has none."""
        return (self.folder / f"{stem}.png").is_file()

    def read(self, stem: str) -> NDArray[np.uint8]:
        """Read the labels (H, W) of the undistorted image.

        Raises:
            MissingFileError: There is none.
        """
        labels = read_labels(self.folder / f"{stem}.png")
        return labels if self.lens is None else undistort_labels(labels, self.lens)


def is_heldout(index: int) -> bool:
    """Return whether the scan image at this index in name order is held out for evaluation."""
    return index % 8 == 4


def score_scan(
    capture: Recording,
    cameras: dict[str, Camera],
    scan_state: TwinState,
    masks: TrueMasks,
    render: RenderTwin,
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Compute PSNR and SSIM of the held-out scan views, and part IoUs there.

    Returns:
        Metrics by dotted name, and IoUs by part (one per view), to be pooled with the video's.
    """
    values: dict[str, list[float]] = {"psnr": [], "ssim": [], "objects": []}
    ious: dict[str, list[float]] = {name: [] for name in PARTS}
    for index, path in enumerate(capture.scan_images):
        if not is_heldout(index) or path.name not in cameras:
            continue
        real = read_image(path)
        image, labels = render(cameras[path.name], scan_state)
        drawn, photographed = image.astype(np.float64) / 255, real.astype(np.float64) / 255
        values["psnr"].append(psnr(drawn, photographed))
        values["ssim"].append(ssim(drawn, photographed))
        if not masks.has(path.stem):
            continue
        true = masks.read(path.stem)
        values["objects"].append(masked_psnr(image, real, true > 0))
        add_ious(ious, labels, true)
    if not values["psnr"]:
        return {"images.heldout_psnr": None, "images.heldout_ssim": None}, ious
    figures = {
        "images.heldout_psnr": float(np.mean(values["psnr"])),
        "images.heldout_ssim": float(np.mean(values["ssim"])),
        "images.heldout_psnr_objects": float(np.nanmean(values["objects"])) if values["objects"] else None,
        "images.heldout_views": len(values["psnr"]),
    }
    return figures, ious


def score_replay(
    video: Video,
    camera: Camera,
    states: list[TwinState],
    masks: TrueMasks,
    render: RenderTwin,
    fitted: Collection[int],
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Compute PSNR of the twin's replay against unfitted frames, by true masks, and IoUs on every 5th frame.

    Args:
        video: The demonstration video.
        camera: Its estimated camera, world frame.
        states: Estimated state at every frame.
        masks: True masks of its frames.
        render: Renders the twin.
        fitted: Frames to which the twin's appearance was fitted.
    """
    unseen = sorted(set(range(len(states))) - set(fitted))
    errors: dict[str, list[NDArray]] = {"robot": [], "moving": [], "rest": []}
    ious: dict[str, list[float]] = {part: [] for part in PARTS}
    for index, state in enumerate(states):
        real = video.frames_srgb[index]
        image, labels = render(camera, state)
        true = masks.read(f"{index:04d}")
        squared = ((image.astype(np.float64) - real) / 255) ** 2
        robot = binary_dilation(true == ROBOT, iterations=ROBOT_MARGIN_PX)
        moving = (true == MOVING) & ~robot
        if index in unseen:
            for key, mask in (("robot", robot), ("moving", moving), ("rest", ~robot & ~moving)):
                errors[key].append(squared[mask].ravel())
        if index % 5 == 0:
            add_ious(ious, labels, true)
    figures = {
        f"images.replay_psnr_{key}": float(-10 * np.log10(np.concatenate(parts).mean()))
        for key, parts in errors.items()
    }
    return figures | {"images.replay_unseen_frames": len(unseen)}, ious


def pooled_ious(*sources: dict[str, list[float]]) -> dict[str, float | None]:
    """Compute mean and 10th percentile of each part's IoUs over all scored images."""
    figures: dict[str, float | None] = {}
    for name in PARTS:
        values = [value for source in sources for value in source[name]]
        figures[f"parts.{name}_iou"] = float(np.mean(values)) if values else None
        figures[f"parts.{name}_iou_p10"] = float(np.percentile(values, 10)) if values else None
    return figures


def add_ious(ious: dict[str, list[float]], labels: NDArray[np.uint8], true: NDArray[np.uint8]) -> None:
    """Append the IoU of each part that is in either image."""
    for name, label in PARTS.items():
        union = ((labels == label) | (true == label)).sum()
        if union:
            ious[name].append(float(((labels == label) & (true == label)).sum() / union))


def masked_psnr(image: NDArray[np.uint8], real: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    """Compute the PSNR over the masked pixels, [dB]; nan for an empty mask."""
    if not mask.any():
        return float("nan")
    difference = (image[mask].astype(np.float64) - real[mask]) / 255
    return float(-10 * np.log10(np.mean(difference**2)))
