"""Result of structure from motion: cameras and sparse points of a scan, and the images held out of training."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import Prompt
from aomgen.core.values import Array, freeze_arrays

# One of this many images is held out, as benchmarks of view synthesis do (Mip-NeRF 360).
HELD_OUT_EVERY = 8
# Index of the first one; the image with which the walk begins is used for training.
HELD_OUT_PHASE = 4
Figures = dict[str, object]


@dataclass(frozen=True, slots=True, kw_only=True)
class PinholeScan:
    """Undistorted images of a scan that is a video or has lens distortion; files below the stage's folder.

    Attributes:
        images: Undistorted images.
        masks: Folders of undistorted label images, by name; None = the recorded ones.
        prompts: A person's annotations, in pixels of these images.
    """

    images: tuple[str, ...]
    masks: dict[str, str] | None
    prompts: tuple[Prompt, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """A sparse model of the scene in the `recon` frame (no scale, no gravity).

    Attributes:
        cameras_recon: Registered scan images by file name, in name order.
        demo_cameras_recon: Fixed cameras by name.
        scan_lens: Optics of the scan images when they are distorted: `cameras_recon` and
            all other values here belong to the undistorted images. None = pinhole images.
        demo_lenses: The same for the fixed cameras that are distorted.
        pinhole: The scan of the undistorted images; None = the recorded one.
        dropped: Scan images that are not in the model, with the reason.
        points_recon: Points (P, 3).
        colors_srgb: Colors (P, 3) uint8.
        observations: (M, 2) int32, rows of (point, index into `cameras_recon` in order).
        reprojection_error_px: Mean over all observations, [px].
        figures: Measured numbers for the manifest (JSON values).
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
