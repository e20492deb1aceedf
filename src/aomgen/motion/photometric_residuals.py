"""Joint and joint values that make the moved part look like the video: Gauss-Newton on pixels.

A frame's picture depends on at most five numbers (axis 2, origin 2, value 1), so its derivatives are
five more drawings. That costs about as much as one backward pass of the engine, but gives every
pixel's derivative by every unknown: the solver converges in a few steps where gradient descent needs
tens of them, and its normal matrix is the covariance.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.core.joint import Joint
from aomgen.core.robust import robust_sd
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.motion.joint_models import make_tangent_basis
from aomgen.motion.part_renderer import FloatImage, PartRenderer, find_interior

# Change of the picture by which derivatives are measured, [px].
_STEP_PX = 0.5
# A grey level: no residual is trusted to be smaller, 0..1.
_NOISE_FLOOR = 1 / 255
# Residuals beyond this many scales count little (Geman-McClure).
_OUTLIER = 2.5
# Rounds of iteratively reweighted least squares; weights change little after these.
_REWEIGHTINGS = 5
# Side of the squares whose residuals are taken to be independent of each other, [px].
_BLOCK_PX = 16
# Number of such squares, 32 each way: 512 px, more than a crop of `max_pixels` is wide as a rule.
BLOCKS = 32 * 32
# A joint, and its values at the video's frames (T,).
JointMotion = tuple[Joint, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Which image detail is compared.

    Attributes:
        blur_px: Detail finer than this is left out, [px].
        wide_px: Shading coarser than this is left out too, [px].
        margin_px: Rim of the part that is left out, [px].
    """

    blur_px: float
    wide_px: float
    margin_px: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearizedFrame:
    """A frame's residuals and their derivatives, nuisances projected out.

    Attributes:
        residuals: (P,), 0..1.
        derivatives: By axis, origin and value (P, n + 1).
        slopes: By a shift of the part's picture to the right and down (P, 2), per pixel.
        weights: Robust weights (P,).
        scale: Robust standard deviation of the residuals.
        blocks: Square of the part that each pixel shows (P,), 0 .. BLOCKS - 1.
    """

    residuals: Array
    derivatives: Array
    slopes: Array
    weights: Array
    scale: float
    blocks: NDArray[np.intp]

    @property
    def shift_information(self) -> float:
        """Information of independent pixels about the best seen shift of the picture, [1/px^2]."""
        weighted = self.slopes * (self.weights / self.scale**2)[:, None]
        return float(np.linalg.eigvalsh(weighted.T @ self.slopes)[-1])


def shift_joint(joint: Joint, pivot: Array, x: Array) -> Joint:
    """A joint tilted by x[:2] [rad] and, if revolute, moved by x[2:4] [m] across its axis at `pivot` (3,)."""
    tangents = make_tangent_basis(joint.axis)
    axis = joint.axis + x[:2] @ tangents
    offset = x[2:4] @ tangents if joint.type == "revolute" else np.zeros(3)
    return replace(joint, axis=axis / np.linalg.norm(axis), origin=pivot + offset)


def choose_steps(renderer: PartRenderer, joint: Joint) -> Array:
    """Changes of tilt (2), shift (2, revolute only) and value that move the picture by half a pixel."""
    camera = renderer.camera
    meters = _STEP_PX * float(np.linalg.norm(renderer.focus - camera.center)) / camera.fx
    turn = meters / renderer.reach_m
    if joint.type == "prismatic":
        return np.array([turn, turn, meters])
    return np.array([turn, turn, meters, meters, turn])


def linearize_frame(
    renderer: PartRenderer, frame: int, neighbours: list[tuple[Joint, float]], band: Band
) -> LinearizedFrame | None:
    """Compare a frame with its drawing.

    Args:
        renderer: The video and the painted part.
        frame: Video frame.
        neighbours: Joint and value to compare at, then those with one unknown changed by its step.
        band: Detail that is compared.

    Returns:
        None where too little of the part is seen.
    """
    picture, hidden = renderer.at(frame)
    views = [renderer.draw(*place) for place in neighbours]
    mask = find_interior(views[0], hidden, band.margin_px)
    if mask.sum() < _BLOCK_PX**2:
        return None
    first = views[0]
    sizes = choose_steps(renderer, neighbours[0][0])
    columns = [picture * first.alpha - first.luma, first.luma, first.alpha]
    columns += [
        (view.luma - first.luma - picture * (view.alpha - first.alpha)) / size
        for view, size in zip(views[1:], sizes, strict=False)
    ]
    down, right = np.gradient(first.luma)
    columns += [right, down]
    values = _banded(np.stack(columns, -1).astype(np.float32), mask, band)
    residuals, nuisances, derivatives = values[:, 0], values[:, 1:3], values[:, 3:]
    weights = np.ones(len(residuals))
    left, scale = residuals, _NOISE_FLOOR
    for _ in range(_REWEIGHTINGS):
        left = residuals - nuisances @ _regression(nuisances, residuals[:, None], weights)[:, 0]
        scale = max(robust_sd(left), _NOISE_FLOOR)
        weights = 1 / (1 + (left / (_OUTLIER * scale)) ** 2) ** 2
    derivatives = derivatives - nuisances @ _regression(nuisances, derivatives, weights)
    return LinearizedFrame(
        residuals=left,
        derivatives=derivatives[:, :-2],
        slopes=derivatives[:, -2:],
        weights=weights,
        scale=scale,
        blocks=_blocks(renderer, neighbours[0], mask),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameComparison:
    """How well two answers explain one frame, over the pixels that both see.

    Attributes:
        cost_before, cost_after: Robust cost, 0..1.
        explained_before, explained_after: Share of the video's detail that the answer explains, 1 at best.
        blocks: Number of independent squares that were compared.
    """

    cost_before: float
    cost_after: float
    explained_before: float
    explained_after: float
    blocks: float

    @property
    def margin(self) -> float:
        """Twice the log evidence of the second answer over the first: each square counts once."""
        return _OUTLIER**2 * self.blocks * (self.cost_before - self.cost_after)


def compare_frames(
    renderer: PartRenderer, frames: NDArray[np.intp], before: JointMotion, after: JointMotion, band: Band
) -> list[FrameComparison]:
    """Compare two answers at frames (N,); those that show too little of the part are left out."""
    found = [
        _compared(renderer, int(k), [(joint, float(thetas[k])) for joint, thetas in (before, after)], band)
        for k in frames
    ]
    return [item for item in found if item is not None]


def _compared(
    renderer: PartRenderer, frame: int, places: list[tuple[Joint, float]], band: Band
) -> FrameComparison | None:
    picture, hidden = renderer.at(frame)
    before, after = (renderer.draw(*place) for place in places)
    mask = find_interior(before, hidden, band.margin_px) & find_interior(after, hidden, band.margin_px)
    if mask.sum() < (2 * band.wide_px) ** 2:
        return None
    columns = [picture]
    for view in (before, after):
        alpha = np.maximum(view.alpha, 0.5)
        columns += [view.luma / alpha]
    values = _banded(np.stack(columns, -1).astype(np.float32), mask, band)
    seen, fits = values[:, 0], [_settled(values[:, :1], drawn[:, None]) for drawn in values.T[1:]]
    scale = max(min(fit[1] for fit in fits), _NOISE_FLOOR)
    costs, shares = [], []
    for left, _ in fits:
        costs.append(float(np.mean(left**2 / (left**2 + (_OUTLIER * scale) ** 2))))
        weights = 1 / (1 + (left / (_OUTLIER * scale)) ** 2) ** 2
        shares.append(1 - float((weights @ left**2) / max(weights @ seen**2, 1e-12)))
    return FrameComparison(
        cost_before=costs[0],
        cost_after=costs[1],
        explained_before=shares[0],
        explained_after=shares[1],
        # Shading coarser than `wide_px` is left out, so that residuals twice as far apart know nothing of each other.
        blocks=float(mask.sum()) / (2 * band.wide_px) ** 2,
    )


def _settled(seen: Array, drawn: Array) -> tuple[Array, float]:
    """What a drawing (P, 1) leaves of the video's detail (P, 1) at its best gain: (P,), and its scale."""
    weights = np.ones(len(seen))
    left, scale = seen[:, 0], _NOISE_FLOOR
    for _ in range(_REWEIGHTINGS):
        left = (seen - drawn @ _regression(drawn, seen, weights))[:, 0]
        scale = max(robust_sd(left), _NOISE_FLOOR)
        weights = 1 / (1 + (left / (_OUTLIER * scale)) ** 2) ** 2
    return left, scale


def _blocks(renderer: PartRenderer, place: tuple[Joint, float], mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Squares that move with the part: what the scan has wrong about it comes back in every frame."""
    joint, theta = place
    (middle,), _ = renderer.camera.project(apply(joint.motion(theta), renderer.focus)[None])
    rows, columns = np.nonzero(mask)
    side = int(np.sqrt(BLOCKS))
    squares = [
        np.clip(np.floor((cells + 0.5 - center) / _BLOCK_PX).astype(int) + side // 2, 0, side - 1)
        for cells, center in ((rows, middle[1]), (columns, middle[0]))
    ]
    return np.asarray(squares[0] * side + squares[1])


def _banded(images: FloatImage, mask: NDArray[np.bool_], band: Band) -> Array:
    """Images (H, W, C) without the finest detail and without shading, inside the mask: (P, C).

    Linear in the images, so that residuals and derivatives stay each other's.
    """
    inside = mask[..., None].astype(np.float32)
    wide_px = float(np.hypot(band.blur_px, band.wide_px))
    fine, coarse = (
        _blurred(images * inside, sigma) / np.maximum(_blurred(inside, sigma), 1e-3)
        for sigma in (band.blur_px, wide_px)
    )
    return np.asarray((fine - coarse)[mask], np.float64)


def _blurred(images: FloatImage, sigma: float) -> FloatImage:
    blurred = ndimage.gaussian_filter(images, (sigma, sigma, 0), mode="constant", truncate=3)
    return np.asarray(blurred, np.float32)


def _regression(columns: Array, targets: Array, weights: Array) -> Array:
    """Coefficients (N, M) of columns (P, N) that give targets (P, M); columns that say nothing get 0."""
    weighted = columns * weights[:, None]
    normal = weighted.T @ columns
    normal += (1e-3 * np.trace(normal) + 1e-9) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal, weighted.T @ targets), np.float64)
