"""A scene as a scan represents it: Gaussians on the visible surfaces, with the errors of reconstructions."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.progress import silent
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.robots.silhouette import FAR_M
from aomgen.simulation.scene_renderer import SceneRenderer
from aomgen.splatting.optimizer import RATES
from aomgen.splatting.training import TrainingParams, train
from benchmarks.motion_upstream import SolidStatistics, Upstream

# Distance between neighboring Gaussians by label, [m]; with these the counts are those of finished runs:
# moving 1900-3300, static 5800-10600, robot 17000-20000, everything else about 70000.
SPACING_M: Final = {MOVING: 0.0065, STATIC: 0.0075, ROBOT: 0.0068}
# Training puts more Gaussians on bars: 40-80 solid ones on a handle.
BAR_SPACING_M: Final = 0.004
# Spacing of the background: near the table, and as a share of the distance from it.
NEAR_SPACING_M: Final = 0.012
FAR_SPACING_SHARE: Final = 0.03
# Larger depth steps, as a share of the depth, are outlines, not slopes.
OUTLINE_SHARE: Final = 0.02
# Iterations that fit colors and opacities to the scan's images.
LESSONS: Final = 220


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Points that the scan shows, world frame; N of each.

    Attributes:
        points: (N, 3), [m].
        normals: Unit, towards the camera that saw them (N, 3).
        colors_srgb: (N, 3), 0..1.
        labels: (N,), see `conventions`.
    """

    points: Array
    normals: Array
    colors_srgb: Array
    labels: NDArray[np.uint8]

    def select(self, which: NDArray) -> "Surface":
        """Select the points of a mask or an index array."""
        return Surface(
            points=self.points[which],
            normals=self.normals[which],
            colors_srgb=self.colors_srgb[which],
            labels=self.labels[which],
        )


def seen_surface(
    painter: SceneRenderer, cameras: list[Camera], qpos: Array, middle: Array, rng: np.random.Generator
) -> tuple[Surface, list[NDArray[np.uint8]]]:
    """Unproject the images of a walk and reduce the points to the density of a reconstruction.

    Args:
        painter: Renderer of the compiled world.
        cameras: The walk.
        qpos: State (nq,) of the world during the scan.
        middle: Position of the object (3,), world frame, [m].
        rng: Chooses the remaining points.

    Returns:
        The surface and the clean images.
    """
    pieces, images = [], []
    for camera in cameras:
        images.append(painter.draw(camera, qpos))
        pieces.append(
            _unprojected(camera, images[-1], painter.labels(camera, qpos), painter.depths(camera, qpos))
        )
    joined = Surface(
        points=np.concatenate([piece.points for piece in pieces]),
        normals=np.concatenate([piece.normals for piece in pieces]),
        colors_srgb=np.concatenate([piece.colors_srgb for piece in pieces]),
        labels=np.concatenate([piece.labels for piece in pieces]),
    )
    dense = _thinned(joined, joined.labels == MOVING, middle, rng)
    return _thinned(dense, _on_bars(dense), middle, rng), images


def _unprojected(
    camera: Camera, image: NDArray[np.uint8], labels: NDArray[np.uint8], depths: Array
) -> Surface:
    points = camera.center + camera.directions() * depths[..., None]
    across, down = (_slope(points, depths, axis) for axis in (1, 0))
    normals = np.cross(down, across)
    lengths = np.linalg.norm(normals, axis=-1)
    rays = camera.center - points
    normals = normals / np.maximum(lengths, 1e-12)[..., None]
    normals *= np.sign(np.einsum("hwd,hwd->hw", normals, rays))[..., None]
    good = (depths < 0.9 * FAR_M) & (lengths > 1e-12)
    return Surface(
        points=points[good], normals=normals[good], colors_srgb=image[good] / 255.0, labels=labels[good]
    )


def _slope(points: Array, depths: Array, axis: int) -> Array:
    """Compute the difference to the neighbor (H, W, 3) on the side where the depth changes less."""
    ahead, behind = np.roll(points, -1, axis) - points, points - np.roll(points, 1, axis)
    step_ahead, step_behind = (
        np.abs(np.roll(depths, -1, axis) - depths),
        np.abs(depths - np.roll(depths, 1, axis)),
    )
    slope = np.where((step_ahead <= step_behind)[..., None], ahead, behind)
    flat = np.minimum(step_ahead, step_behind) < OUTLINE_SHARE * depths
    return np.where(flat[..., None], slope, 0.0)


def spacings(points: Array, labels: NDArray[np.uint8], middle: Array) -> Array:
    """Compute the required distance between neighbors (N,), [m]."""
    away = np.maximum(np.linalg.norm(points - middle, axis=1) - 0.6, 0.0)
    result = np.maximum(NEAR_SPACING_M, FAR_SPACING_SHARE * away)
    for label, spacing in SPACING_M.items():
        result[labels == label] = spacing
    return result


def _thinned(surface: Surface, bars: NDArray[np.bool_], middle: Array, rng: np.random.Generator) -> Surface:
    """Keep one point of every cell; cells are cubes as wide as the spacing, rounded to steps of 20 %."""
    order = rng.permutation(len(surface.points))
    points, labels = surface.points[order], surface.labels[order]
    wanted = np.where(bars[order], BAR_SPACING_M, spacings(points, labels, middle))
    steps = np.round(np.log(wanted) / np.log(1.2))
    cells = np.floor((points - middle) / (1.2**steps)[:, None]).astype(np.int64)
    # Each cell gets one number: 2^17 cells along each axis, 2^8 steps and labels.
    kinds = 4 * (steps - steps.min()).astype(np.int64) + labels
    keys = ((cells + (1 << 16)) << np.array([0, 17, 34])).sum(1) + (kinds << 51)
    _, first = np.unique(keys, return_index=True)
    return surface.select(order[first])


def displaced(surface: Surface, upstream: Upstream, rng: np.random.Generator) -> Array:
    """Displace the reconstructed surface along its normals, in patches; returns positions (N, 3)."""
    places = surface.points.copy()
    draws = _patchy(surface.points, upstream, rng)
    thin = _on_bars(surface)
    for which, statistics in ((thin, upstream.bars), (~thin, upstream.walls)):
        offsets = statistics.offsets_m(draws[which])
        places[which] += offsets[:, None] * surface.normals[which]
    floats = rng.random(len(places)) < upstream.floaters
    distances = 1e-3 * upstream.floaters_mm * rng.standard_exponential(int(floats.sum()))
    places[floats] += distances[:, None] * surface.normals[floats]
    return places


def _patchy(points: Array, upstream: Upstream, rng: np.random.Generator) -> Array:
    """Draw normal scores (N,): a shared one within each patch, and one of each point."""
    cells = np.floor(points / upstream.patch_m + rng.uniform(0, 1, 3)).astype(np.int64)
    _, which = np.unique(cells, axis=0, return_inverse=True)
    shared = rng.standard_normal(int(which.max()) + 1)[which.ravel()]
    share = upstream.patch_share
    return np.sqrt(share) * shared + np.sqrt(1 - share) * rng.standard_normal(len(points))


def _on_bars(surface: Surface) -> NDArray[np.bool_]:
    """Find points of the moving part (N,) with its opposite surface within 2.5 cm behind them: handles."""
    result = np.zeros(len(surface.points), bool)
    moving = np.flatnonzero(surface.labels == MOVING)
    if not len(moving):
        return result
    points, normals = surface.points[moving], surface.normals[moving]
    pairs = cKDTree(points).query_pairs(0.025, output_type="ndarray")
    opposite = np.einsum("nd,nd->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) < -0.5
    result[moving[np.unique(pairs[opposite])]] = True
    return result


def raw_gaussians(surface: Surface, middle: Array, upstream: Upstream, rng: np.random.Generator) -> Gaussians:
    """Make Gaussians (N) of the measured shapes and opacities at displaced points."""
    count = len(surface.points)
    statistics: SolidStatistics = upstream.walls
    opacities = statistics.opacities(rng.random(count))
    wanted = spacings(surface.points, surface.labels, middle)
    widths = np.where(_on_bars(surface), BAR_SPACING_M, wanted) / SPACING_M[MOVING]
    spread = np.exp(rng.normal(0, statistics.size_log_sd, (count, 1)) + rng.normal(0, 0.4, (count, 3)))
    scales = np.array(statistics.scales_m) * spread * widths[:, None]
    tilt = rng.normal(0, statistics.tilt_rad, (count, 3))
    normals = surface.normals + np.cross(tilt, surface.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    side = np.cross(normals, rng.standard_normal((count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    R = np.stack([normals, side, np.cross(normals, side)], -1)
    return gaussians_of(
        means=displaced(surface, upstream, rng),
        quats=quat_from_matrix(R),
        scales=np.minimum(scales, 0.3),
        opacities=opacities,
        sh=((surface.colors_srgb - 0.5) / SH_C0)[:, None],
    )


def learned(
    gaussians: Gaussians, cameras: list[Camera], images: list[NDArray[np.uint8]], rng: np.random.Generator
) -> Gaussians:
    """Fit colors and opacities to the scan's images; positions are fixed.

    All Gaussians are kept, in order, whatever their opacity.
    """
    params = TrainingParams(
        iterations=LESSONS,
        downsampling=((0.0, 2), (0.8, 1)),
        max_gaussians=len(gaussians),
        grow_every=2 * LESSONS,
        min_opacity=0.0,
        rates={**RATES, "means": 3e-5, "log_scales": 2e-2, "logit_opacities": 5e-2, "color": 3e-2},
        exposure=False,
    )
    return train(gaussians, cameras, images, params, silent, rng)
