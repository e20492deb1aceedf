"""What a fitted lens leaves over: shifts that features at one place of the picture share in all images."""

import numpy as np
import pycolmap

from aomgen.errors import ReconstructionError
from aomgen.structure.lens_choice import residuals

# Cells across and down the image.
CELLS = np.array([8, 6])
# Features a cell for a stable median.
MIN_FEATURES = 30
# The right model leaves 0.01 to 0.02 px, a pinhole where the border is bent by 5 px leaves 0.07 px.
MAX_MISFIT_PX = 0.25


def lens_misfit_px(model: pycolmap.Reconstruction) -> float:
    """Root mean square, over cells of the picture, of the median shift of features from their points, [px]."""
    found = residuals(model)
    pixels, shifts = (np.concatenate(part) for part in zip(*found, strict=True))
    camera = next(iter(model.cameras.values()))
    cells = np.clip((pixels / [camera.width, camera.height] * CELLS).astype(int), 0, CELLS - 1) @ [
        CELLS[1],
        1,
    ]
    medians = [
        np.median(shifts[cells == cell], axis=0)
        for cell in range(CELLS.prod())
        if np.sum(cells == cell) >= MIN_FEATURES
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(medians), axis=1)))) if medians else 0.0


def require_lens_fits(misfit_px: float, where: str) -> None:
    """Refuse images whose lens no model describes.

    Raises:
        ReconstructionError: With the shift that is left.
    """
    if not misfit_px <= MAX_MISFIT_PX:
        raise ReconstructionError(
            where,
            f"is bent in a way that no lens model explains: features lie {misfit_px:.2f} px aside at the same "
            f"places of all images, limit {MAX_MISFIT_PX:.2f} px",
            "record with the main lens, without fisheye, zoom, stabilisation or cropping",
        )
