"""The video compared with the drawn part, inside its painted surface.

A frame's picture depends on at most five numbers (axis 2, origin 2, value 1), so its derivatives are
five more drawings: as cheap as one backward pass of the engine, and every pixel's derivative by every unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.joint import Joint
from aomgen.core.robust import robust_sd
from aomgen.core.values import Array
from aomgen.motion.part_renderer import FloatImage, PartRenderer, PartRendering, find_interior

# A grey level: no residual is trusted to be smaller, 0..1.
_NOISE_FLOOR = 1 / 255
# Residuals beyond this many standard deviations count little (Geman-McClure).
_OUTLIER = 2.5
# Rounds of iteratively reweighted least squares; weights change little after these.
_REWEIGHTINGS = 5
# A joint, and its values at the video's frames (T,).
JointMotion = tuple[Joint, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Which image detail is compared: none finer than `blur_px`, no shading coarser than `wide_px`, [px]."""

    blur_px: float
    wide_px: float

    @property
    def noise_px(self) -> float:
        """Pixels that share their noise: a Gaussian blur's area, [px^2]."""
        return max(1.0, 4 * np.pi * self.blur_px**2)

    @property
    def shading_px(self) -> float:
        """Pixels that may share what the drawing has wrong, [px^2]."""
        return (2 * self.wide_px) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearizedFrame:
    """A frame's residuals (P,), their derivatives (P, m) and weights (P,), 1 / variance, light fitted."""

    residuals: Array
    derivatives: Array
    weights: Array


def linearize_frame(
    renderer: PartRenderer,
    frame: int,
    places: Sequence[tuple[Joint, float]],
    steps: Array,
    band: Band,
    shift_sd_px: float,
) -> LinearizedFrame | None:
    """Compare a frame with its drawing; None where it shows too little of the part.

    Args:
        renderer: The video and the painted part.
        frame: Video frame.
        places: Joint and value to compare at, then with one unknown each changed by its step.
        steps: The changes (m,).
        band: Detail that is compared.
        shift_sd_px: Smooth displacements of the picture by this much are no evidence.
    """
    picture, hidden = renderer.at(frame)
    first, *others = (renderer.draw(*place) for place in places)
    mask = find_interior(first, hidden)
    if mask.sum() < band.shading_px:
        return None
    changes = [
        (view.luma - first.luma - picture * (view.alpha - first.alpha)) / step
        for view, step in zip(others, steps, strict=True)
    ]
    slopes = np.gradient(first.luma)
    light = _fit_light(picture, first, mask, band, [*changes, *slopes])
    precisions = _weigh(light.residuals, light.sd) / light.sd**2
    derivatives, slopes = np.split(light.others, [len(steps)], axis=1)
    shift_precision = np.linalg.eigvalsh(slopes.T * precisions @ slopes)[-1]
    return LinearizedFrame(
        residuals=light.residuals,
        derivatives=derivatives,
        weights=precisions / (band.noise_px + shift_sd_px**2 * shift_precision),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """How well two answers explain F frames, over the pixels that both see.

    Attributes:
        costs: Mean robust cost (F, 2), 0..1.
        explained: Share of the video's detail that is explained (F, 2), 1 at best.
        squares: Independent squares that were compared (F,).
    """

    costs: Array
    explained: Array
    squares: Array

    @property
    def gains(self) -> Array:
        """Cost of the first answer less that of the second (F,)."""
        return self.costs[:, 0] - self.costs[:, 1]

    @property
    def margin(self) -> float:
        """Twice the log evidence of the second answer over the first: each square counts once."""
        return _OUTLIER**2 * float(self.squares @ self.gains)


def compare_frames(
    renderer: PartRenderer, frames: NDArray[np.intp], answers: tuple[JointMotion, JointMotion], band: Band
) -> Comparison:
    """Compare two answers at frames (N,); those that show too little of the part are left out."""
    costs, explained, squares = [], [], []
    for frame in frames:
        picture, hidden = renderer.at(frame)
        views = [renderer.draw(joint, float(thetas[frame])) for joint, thetas in answers]
        mask = find_interior(views[0], hidden) & find_interior(views[1], hidden)
        if mask.sum() < band.shading_px:
            continue
        lights = [_fit_light(picture, view, mask, band) for view in views]
        sd = min(light.sd for light in lights)
        squared = np.stack([light.residuals for light in lights]) ** 2
        weights = _weigh(np.sqrt(squared), sd)
        detail = np.stack([light.detail for light in lights]) ** 2
        costs.append(np.mean(squared / (squared + (_OUTLIER * sd) ** 2), axis=1))
        explained.append(1 - (weights * squared).sum(1) / np.maximum((weights * detail).sum(1), 1e-12))
        squares.append(mask.sum() / band.shading_px)
    shape = (len(squares), 2)
    return Comparison(
        costs=np.reshape(costs, shape), explained=np.reshape(explained, shape), squares=np.array(squares)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Light:
    """A picture compared with a drawing at its best gain and offset.

    Attributes:
        detail: Of the picture (P,).
        residuals: What the drawing leaves of it (P,), 0..1.
        sd: Their robust standard deviation.
        others: Other images' detail (P, M), gain and offset projected out.
    """

    detail: Array
    residuals: Array
    sd: float
    others: Array


def _fit_light(
    picture: FloatImage,
    view: PartRendering,
    mask: NDArray[np.bool_],
    band: Band,
    others: Sequence[NDArray[np.floating]] = (),
) -> _Light:
    images = [picture * view.alpha - view.luma, view.luma, view.alpha, *others]
    bands = _extract_band(np.stack(images, -1).astype(np.float32), mask, band)
    light, targets = bands[:, 1:3], np.delete(bands, (1, 2), axis=1)
    weights, sd = np.ones(len(bands)), _NOISE_FLOOR
    for _ in range(_REWEIGHTINGS):
        residuals = (targets[:, :1] - light @ _regress(light, targets[:, :1], weights))[:, 0]
        sd = max(robust_sd(residuals), _NOISE_FLOOR)
        weights = _weigh(residuals, sd)
    left = targets - light @ _regress(light, targets, weights)
    return _Light(detail=bands[:, 0] + bands[:, 1], residuals=left[:, 0], sd=sd, others=left[:, 1:])


def _weigh(residuals: Array, sd: float) -> Array:
    """Geman-McClure weights, 1 for residuals of 0."""
    return 1 / (1 + (residuals / (_OUTLIER * sd)) ** 2) ** 2


def _regress(columns: Array, targets: Array, weights: Array) -> Array:
    """Coefficients (N, M) of columns (P, N) that give targets (P, M); columns that say nothing get 0."""
    weighted = columns * weights[:, None]
    normal = weighted.T @ columns
    normal += (1e-3 * np.trace(normal) + 1e-9) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal, weighted.T @ targets), np.float64)


def _extract_band(images: FloatImage, mask: NDArray[np.bool_], band: Band) -> Array:
    """Images (H, W, C) without the finest detail and without shading, inside the mask: (P, C).

    Linear in the images, so that residuals and derivatives stay each other's.
    """
    inside = mask[..., None].astype(np.float32)
    fine, coarse = (
        _blur(images * inside, sigma) / np.maximum(_blur(inside, sigma), 1e-3)
        for sigma in (band.blur_px, float(np.hypot(band.blur_px, band.wide_px)))
    )
    return np.asarray((fine - coarse)[mask], np.float64)


def _blur(images: FloatImage, sigma: float) -> FloatImage:
    return np.asarray(ndimage.gaussian_filter(images, (sigma, sigma, 0), mode="constant", truncate=3))
