"""Result of structure from motion: cameras and sparse points of a scan; selection of held-out images."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import Prompt
from aomgen.core.values import Array, freeze_arrays

# Spacing, in name order, of the images that are held out of training, as in benchmarks of view synthesis (Mip-NeRF 360).
HELD_OUT_EVERY = 8
# Index of the first held-out image; the image with which the scan begins is used for training.
HELD_OUT_PHASE = 4
Figures = dict[str, object]


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeScan:
    """Undistorted images of a scan that is a video or has lens distortion, as paths relative to the stage's folder.

    Attributes:
        images: Undistorted images.
        masks: Folders of undistorted label images, by name; None if the recorded ones are used.
        prompts: A person's annotations, in pixels of these images.
    """

    images: tuple[str, ...]
    masks: dict[str, str] | None
    prompts: tuple[Prompt, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """A sparse model of the scene in the `recon` frame, whose scale and vertical direction are unknown.

    Attributes:
        cameras_recon: Cameras of the registered scan images by file name, in name order.
        demo_cameras_recon: Fixed cameras by name.
        scan_lens: Lens of the scan images if they are distorted; `cameras_recon` and all other values then refer to the
            undistorted images. None for pinhole images.
        demo_lenses: Lenses of the fixed cameras with distorted images, by name.
        pinhole: Undistorted scan; None if the recorded images are used.
        dropped: Reasons by the names of the scan images that are not in the model.
        points_recon: Points (P, 3).
        colors_srgb: Colors (P, 3) uint8.
        observations: Rows (M, 2) of point index and index into `cameras_recon`, int32.
        reprojection_error_px: Mean reprojection error over all observations, [px].
        figures: Metrics for the manifest, as JSON values.
    """

    cameras_recon: dict[str, Camera]
    demo_cameras_recon: dict[str, Camera]
    dropped: dict[str, str]
    points_recon: Annotated[Array, "P 3"]
    colors_srgb: Annotated[NDArray[np.uint8], "P 3"]
    observations: Annotated[NDArray[np.int32], "_ 2"]
    reprojection_error_px: float
    scan_lens: Lens | None = None
    demo_lenses: dict[str, Lens] = field(default_factory=dict)
    pinhole: PinholeScan | None = None
    figures: Figures = field(default_factory=dict)

    __post_init__ = freeze_arrays


def held_out(names: list[str]) -> list[str]:
    """Select every 8th of all scan images in name order, the 5th first."""
    return [name for i, name in enumerate(sorted(names)) if i % HELD_OUT_EVERY == HELD_OUT_PHASE]
