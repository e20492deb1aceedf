"""Completion of unobserved regions of a surface: smooth color from their border and texture from patches."""

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse.linalg import LaplacianNd, spsolve

from aomgen.core.values import Array

# Patch side, [px].
PATCH: Final = 25
# Random patches compared at each place; the neighbourhood of the best is searched after.
CANDIDATES: Final = 600
# Structure wider than this [px] is color, finer is texture.
SMOOTHING: Final = 15.0


def inpaint(image: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Complete an image (H, W, 3) where it is not known (H, W); without any known pixel it is grey.

    `rng` chooses candidate patches.
    """
    if not known.any():
        return np.full(image.shape, 0.5)
    smooth = continue_smoothly(image, known)
    detail = np.where(known[..., None], image - smooth, 0.0)
    texture = _quilt(detail, known, rng)
    return np.where(known[..., None], image, smooth + texture)


def continue_smoothly(image: Array, known: NDArray[np.bool_]) -> Array:
    """The colors (H, W, C) of an image without its texture, and their smooth continuation to where it is not known."""
    return _membrane(_blur(image, known), known)


def _blur(image: Array, known: NDArray[np.bool_]) -> Array:
    """Known colors averaged over known neighbours."""
    weight = gaussian_filter(known.astype(float), SMOOTHING)
    masked = np.where(known[..., None], image, 0.0)
    total = gaussian_filter(masked, (SMOOTHING, SMOOTHING, 0))
    return total / np.maximum(weight, 1e-6)[..., None]


def _membrane(image: Array, known: NDArray[np.bool_]) -> Array:
    """The smoothest continuation into unknown pixels: Laplace's equation."""
    if known.all():
        return image
    flat = known.ravel()
    laplacian = LaplacianNd(known.shape, boundary_conditions="neumann").tosparse().astype(np.float64)
    rows = laplacian.tocsr()[~flat]
    colors = np.array(image, np.float64).reshape(-1, image.shape[-1])
    filled = spsolve(rows[:, ~flat].tocsc(), -rows[:, flat] @ colors[flat])
    colors[~flat] = np.asarray(filled).reshape(-1, image.shape[-1])
    return colors.reshape(image.shape)


def _quilt(detail: Array, known: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Texture copied patch by patch from the known part, from the border inwards.

    Source: Efros & Freeman 2001, with soft seams.
    """
    half = PATCH // 2
    result, sure = np.array(detail), known.astype(float)
    whole = np.asarray(sliding_window_view(known, (PATCH, PATCH)).all((2, 3)))
    sources = np.argwhere(whole)
    if not len(sources):
        return result
    windows = np.asarray(sliding_window_view(detail, (PATCH, PATCH, 3)))[:, :, 0]
    inner = np.asarray(distance_transform_edt(~known))
    # Neighbouring patches overlap by more than half.
    grid = np.argwhere(~known)
    grid = grid[(grid % half == 0).all(1)]
    grid = grid[np.argsort(inner[tuple(grid.T)], kind="stable")]
    ramp = 1 - np.abs(np.arange(PATCH) - half) / (half + 1)
    feather = np.minimum.outer(ramp, ramp)
    height, width = known.shape
    for row, column in grid:
        r = int(np.clip(row - half, 0, height - PATCH))
        c = int(np.clip(column - half, 0, width - PATCH))
        box = (slice(r, r + PATCH), slice(c, c + PATCH))
        weight = sure[box]
        tries = sources[rng.integers(0, len(sources), CANDIDATES)]
        best = _closest(windows, tries, result[box], weight)
        around = best + np.argwhere(np.ones((7, 7), bool)) - 3
        inside = ((around >= 0) & (around < whole.shape)).all(1)
        around = around[inside]
        best = _closest(windows, around[whole[tuple(around.T)]], result[box], weight)
        patch = windows[best[0], best[1]]
        # A sharp share: averaging many patches would wash the texture out.
        share = np.where(known[box], 0.0, feather**4 / (feather**4 + weight**4))[..., None]
        result[box] = (1 - share) * result[box] + share * patch
        sure[box] = np.where(known[box], 1.0, np.maximum(weight, feather))
    return result


def _closest(windows: NDArray, places: NDArray[np.int64], target: Array, weight: Array) -> NDArray[np.int64]:
    """The place (2,) whose window (P, P, 3) differs least from the target (P, P, 3)."""
    found = windows[places[:, 0], places[:, 1]]
    difference = (found - target) ** 2
    return places[int(np.argmin(np.einsum("nijk,ij->n", difference, weight)))]
