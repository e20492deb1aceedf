"""Search for the pose of the robot: many poses that agree with the prompted boxes, the best improved further.

Boxes do not determine heading and depth, and are drawn manually, so a thousand poses are scored in small images. The robot has
the same colors in all images, and its surroundings have others, so the colors inside and just outside the silhouette, pooled
over a few images, differ most at the true pose. Silhouettes are rendered as points on the surface, thousands per second. The
best poses that differ from one another are perturbed in decreasing steps; contours verify good ones later. Source: a plain
evolution strategy, Beyer and Schwefel, 2002, with niches.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans, vq

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.silhouette_fit import far_apart, limit_width
from aomgen.alignment.starting_poses import RobotBox, find_starting_poses, up_candidates
from aomgen.alignment.uncertainty import CameraErrors
from aomgen.core.camera import camera_in_world
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotConfiguration


@dataclass(frozen=True, slots=True, kw_only=True)
class Generation:
    """One round of the evolution strategy.

    Attributes:
        parents: Number of poses that are kept.
        apart: Least distance between them, as a share of the robot's size.
        children: Number of new poses near each.
        step: Standard deviation of their distance along each axis, as a share of the robot's size.
    """

    parents: int
    apart: float
    children: int
    step: float


# Poses whose misfit to the prompted boxes exceeds the smallest one by this share of a box are dropped; boxes are inexact.
MAX_MISFIT = 0.15
# Width of the images for the first pass over all poses, [px]: links are still a few pixels wide.
FIRST_WIDTH = 48
# Rounds of the search; the first steps have the size of the basin of attraction, about the thickness of a link.
GENERATIONS = (
    Generation(parents=50, apart=0.08, children=6, step=0.06),
    Generation(parents=24, apart=0.06, children=8, step=0.04),
    Generation(parents=12, apart=0.05, children=10, step=0.025),
    Generation(parents=6, apart=0.03, children=12, step=0.012),
)
# Largest number of returned poses: the best and its alternatives, which differ by more than a share of the robot's size.
KEPT, KEPT_APART = 3, 0.5
# Colors in the palette of the images; k-means merges similar ones, so more change little.
COLORS = 40
# Width of the band outside the silhouette, as a share of the image's width: less than the thickness of a link.
RIM = 0.06
# Share of the silhouette in the images below which the score is reduced.
SEEN = 0.5
# Number of poses that are scored at once; it limits the memory and does not change the result.
BATCH = 128
# Number of points on the robot's surface: the distance between neighbors is about one pixel.
SURFACE_POINTS = 1200


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Input of the alignment, from structure and prompts.

    Attributes:
        views: Images that show the robot in its configuration during the scan.
        boxes: Prompted boxes around the robot; two on distant views are better than one.
        errors: Uncertainty of the cameras; None treats them as exact.
    """

    views: list[AlignmentImage]
    boxes: list[RobotBox]
    points_recon: Annotated[Array, "_ 3"]
    errors: CameraErrors | None = None

    __post_init__ = freeze_arrays

    def view_from(self, S_other_recon: Array) -> "Scan":
        """Express the scan in another frame."""
        return Scan(
            views=[
                replace(view, camera_recon=camera_in_world(S_other_recon, view.camera_recon))
                for view in self.views
            ],
            boxes=[
                replace(box, camera_recon=camera_in_world(S_other_recon, box.camera_recon))
                for box in self.boxes
            ],
            points_recon=apply(S_other_recon, self.points_recon),
            errors=self.errors and self.errors.view_from(S_other_recon),
        )


def search_poses(
    scan: Scan,
    configuration: RobotConfiguration,
    rng: np.random.Generator,
    *,
    guesses: int = 2400,
    view_count: int = 8,
    width: int = 80,
) -> tuple[Array, Array]:
    """Find likely poses of the robot, best first and far from one another.

    Args:
        guesses: Number of poses in the first pass.
        view_count, width: Number of the small images, and their width, [px].

    Returns:
        `S_world_recon` (H, 4, 4) and their scores (H,), see `ColorScore`.
    """
    vertices = configuration.points_world()
    probe = vertices[rng.choice(len(vertices), 16, replace=False)]
    ups = up_candidates([view.camera_recon for view in scan.views], scan.points_recon, rng)
    Ss, scores = find_starting_poses(scan.boxes, vertices, ups, scan.points_recon, rng, guesses)
    Ss = Ss[scores >= scores.max() - MAX_MISFIT]
    Ss_recon_world = np.asarray(np.linalg.inv(Ss[:200]), np.float64)
    chosen = _views_on(scan.views, apply(Ss_recon_world, probe.mean(0)), view_count)
    first = ColorScore([limit_width(view, FIRST_WIDTH) for view in chosen], configuration, rng)
    score = ColorScore([limit_width(view, width) for view in chosen], configuration, rng)
    begin = GENERATIONS[0]
    Ss, _ = select_distinct(Ss, first(Ss), probe, begin.apart, begin.parents)
    scores = score(Ss)
    for generation in GENERATIONS:
        parents, _ = select_distinct(Ss, scores, probe, generation.apart, generation.parents)
        children = _near(parents, probe, generation, rng)
        Ss, scores = np.concatenate([Ss, children]), np.concatenate([scores, score(children)])
    return select_distinct(Ss, scores, probe, KEPT_APART, KEPT)


def select_distinct(
    Ss: Array, scores: Array, points_world: Array, apart: float, count: int
) -> tuple[Array, Array]:
    """Select the best poses with their scores, at most `count`, no two nearer than a share of the robot's size.

    Args:
        Ss, scores: Poses `S_world_recon` (H, 4, 4) and their scores (H,), larger is better.
        points_world: Points (P, 3) on the robot, [m].
    """
    Ss_recon_world = np.asarray(np.linalg.inv(Ss), np.float64)
    placed = points_world @ np.swapaxes(Ss_recon_world[:, :3, :3], 1, 2) + Ss_recon_world[:, None, :3, 3]
    sizes = np.linalg.norm(placed - placed.mean(1, keepdims=True), axis=2).mean(1)
    left = np.argsort(-scores, kind="stable")
    kept = []
    while len(left) and len(kept) < count:
        best, left = left[0], left[1:]
        kept.append(best)
        distances = np.linalg.norm(placed[left] - placed[best], axis=2).mean(1)
        left = left[distances > apart * np.sqrt(sizes[left] * sizes[best])]
    return Ss[kept], scores[kept]


def _near(Ss: Array, points_world: Array, generation: Generation, rng: np.random.Generator) -> Array:
    """Sample candidates (C, 4, 4) near a pose: the robot slightly rotated, moved and scaled about its center."""
    middle = points_world.mean(0)
    size = np.linalg.norm(points_world - middle, axis=1).mean()
    count = len(Ss) * generation.children
    turns = matrix_from_rotvec(rng.normal(0, generation.step, (count, 3)) * [0.5, 0.5, 1.0])
    factors = np.exp(rng.normal(0, generation.step, (count, 1, 1)))
    moves = rng.normal(0, generation.step * size, (count, 3))
    turned = factors * turns
    Ds = transform(turned, middle + moves - turned @ middle)
    return np.asarray(np.linalg.inv(Ds) @ np.repeat(Ss, generation.children, axis=0), np.float64)


def _views_on(views: list[AlignmentImage], centers: Array, count: int) -> list[AlignmentImage]:
    """Select the views that show most of the likely robot centers (H, 3), from different sides, widest first."""
    shown = []
    for view in views:
        camera = view.camera_recon
        pixels, z = camera.project(centers)
        shown.append(np.mean((z > 0) & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), 1)))
    usable = [view for view, share in zip(views, shown, strict=True) if share >= 0.7 * max(shown)]
    chosen = far_apart([view.camera_recon.center for view in usable], np.median(centers, axis=0), count)
    return [usable[i] for i in chosen]


class ColorScore:
    """Score of robot poses by the colors inside and just outside the silhouette, in small images of few colors."""

    def __init__(
        self, views: list[AlignmentImage], configuration: RobotConfiguration, rng: np.random.Generator
    ) -> None:
        """Quantize the views, some 80 px wide: an arm's link is then a few pixels thick."""
        pixels = [view.image_srgb.reshape(-1, 3).astype(np.float32) for view in views]
        palette = _palette(np.concatenate(pixels), rng)
        one_hot = np.eye(COLORS, dtype=np.float32)
        self._views = views
        # Each pixel of a view has one row (COLORS,).
        self._labels = [one_hot[vq(part, palette)[0]] for part in pixels]
        points = configuration.surface_world(SURFACE_POINTS, rng)
        self._points = np.concatenate([points, np.ones((SURFACE_POINTS, 1))], 1).astype(np.float32)

    def __call__(self, Ss_world_recon: Array) -> Array:
        """Scores (H,) of similarities (H, 4, 4): 0 = colors do not differ; more for larger outlines."""
        batches = range(0, len(Ss_world_recon), BATCH)
        return np.concatenate([self._batch(Ss_world_recon[first : first + BATCH]) for first in batches])

    def _batch(self, Ss_world_recon: Array) -> Array:
        Ss_recon_world = np.asarray(np.linalg.inv(Ss_world_recon), np.float64)
        count = len(Ss_world_recon)
        inside, outside = np.zeros((count, COLORS)), np.zeros((count, COLORS))
        seen = np.zeros(count)
        for view, labels in zip(self._views, self._labels, strict=True):
            masks, share = self._silhouettes(view, Ss_recon_world)
            rims = _dilate(masks, max(2, round(RIM * view.camera_recon.width))) & ~masks
            inside += masks.reshape(count, -1).astype(np.float32) @ labels
            outside += rims.reshape(count, -1).astype(np.float32) @ labels
            seen += share / len(self._views)
        # Pixels of one link are correlated: evidence is proportional to the length of the outline, not to the area.
        length = np.sqrt(inside.sum(1) / sum(len(labels) for labels in self._labels))
        return divergence(inside, outside) * length * np.minimum(seen / SEEN, 1.0)

    def _silhouettes(self, view: AlignmentImage, Ss_recon_world: Array) -> tuple[NDArray[np.bool_], Array]:
        """Render masks (H, h, w), and compute the share of the robot that is in the image (H,)."""
        camera = view.camera_recon
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        Ms = K @ (camera.T_cam_world @ Ss_recon_world)[:, :3]
        # Pixels are whole numbers here, so single precision is sufficient.
        u, v, z = np.einsum("hij,pj->ihp", Ms.astype(np.float32), self._points, optimize=True)
        depth = np.maximum(z, np.float32(1e-6))
        u, v = np.floor(u / depth), np.floor(v / depth)
        width, height = camera.width, camera.height
        inside = (z > 1e-6) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        first = np.arange(len(Ms), dtype=np.int64)[:, None] * (width * height)
        masks = np.zeros(len(Ms) * width * height, bool)
        masks[(first + np.where(inside, v * width + u, 0).astype(np.int64))[inside]] = True
        masks = masks.reshape(len(Ms), height, width)
        return ~_dilate(~_dilate(masks, 1), 1), inside.mean(1)


def divergence(inside: Array, outside: Array) -> Array:
    """Compute the Jensen-Shannon divergence (H,), 0..1, between pairs of rows of counts (H, K), corrected for bias.

    The bias of small samples is to first order (K - 1) / (4 ln 2) * (1/n + 1/m) bits over 2.
    """
    n, m = inside.sum(1, keepdims=True), outside.sum(1, keepdims=True)
    p, q = inside / np.maximum(n, 1), outside / np.maximum(m, 1)
    mean = (p + q) / 2
    bits = _relative_bits(p, mean) / 2 + _relative_bits(q, mean) / 2
    used = np.sum(mean > 0, axis=1)
    bias = (used - 1) / (8 * np.log(2)) * (1 / np.maximum(n, 1) + 1 / np.maximum(m, 1))[:, 0]
    return np.asarray(np.clip(bits - bias, 0, 1), np.float64)


def _relative_bits(p: Array, mean: Array) -> Array:
    positive = p > 0
    ratio = np.where(positive, p, 1) / np.where(positive, mean, 1)
    return np.sum(p * np.log2(ratio), axis=1)


def _palette(pixels: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Find the typical colors (K, 3) of the images, at most COLORS, from a sample of the pixels."""
    sample = pixels[rng.permutation(len(pixels))[:6000]]
    return kmeans(sample, sample[:COLORS])[0]


def _dilate(masks: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Dilate masks (H, h, w) by a square of side 2 * by + 1."""
    for axis in (1, 2):
        reach = 0
        while reach < by:
            # The range doubles: a mask dilated by r, shifted by up to r + 1 in both directions, is dilated by 2 r + 1.
            step = min(reach + 1, by - reach)
            grown = masks.copy()
            low, high = [slice(None)] * 3, [slice(None)] * 3
            low[axis], high[axis] = slice(None, -step), slice(step, None)
            grown[tuple(low)] |= masks[tuple(high)]
            grown[tuple(high)] |= masks[tuple(low)]
            masks, reach = grown, reach + step
    return masks
