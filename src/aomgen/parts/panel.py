"""An object as two boxes: the moving part, a panel, and the body; and what is known of them by their faces alone.

Masks of doors, drawers and lids are ragged or stop at a window; the boxes make the borders straight.
Panel frame: x level along the panel, y up (across, for a lid), z out of the front, origin on the front face.
Body frame: z up.
Gaussians on a plain front are large and lie across the seam around a drawer or a door. With one label they
would drag a strip of the body along when the part moves, so those that a face passes through are cut in two. Each half
is the moment match of the Gaussian truncated at the face: its mean and covariance, its weight kept, so that images of
the scan stay.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.boxes import find_upright_axes
from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.parts import Cut
from aomgen.core.transforms import apply, invert, matrix_from_quat, quat_from_matrix, transform
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import ReconstructionError

STAGE = "parts"
# Fronts this close to level or upright are so: objects stand on something, and planes are found to a degree
# or two. Lids that stand ajar lean more.
SNAP_DEG = 4.0
# Reconstructed surfaces scatter about their plane by this share of the part's diagonal.
SCATTER_SHARE = 0.015
# RANSAC samples: with a third of inliers a good one is missed with a probability far below 1e-9.
TRIALS = 1000
# Surface pixels below which the normal of a plane is noise.
MIN_POINTS = 50
# A face cuts Gaussians of which it leaves this share on either side, at least.
MIN_SHARE = 0.1
# Opacities end below 1: a Gaussian never blocks all light.
MAX_OPACITY = 0.999


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Where the two boxes are; what lies in both belongs to the moving part.

    Attributes:
        low, high: Corners of the moving part, panel frame, [m]. `low[2]` is the seam behind
            the panel; `high[2]` is how far handles reach.
        body_low, body_high: Corners of the object's body, body frame, [m].
    """

    T_world_panel: Matrix4
    low: Vector3
    high: Vector3
    T_panel_body: Matrix4
    body_low: Vector3
    body_high: Vector3

    __post_init__ = freeze_arrays

    def labels(self, points_world: ArrayLike) -> NDArray[np.uint8]:
        """Part labels (N,) of points (N, 3) by where they are, world frame."""
        return self.labels_local(apply(invert(self.T_world_panel), np.asarray(points_world, np.float64)))

    def labels_seen(self, points_world: Array, center_world: Array) -> NDArray[np.uint8]:
        """Part labels (H, W) of what a camera sees.

        Args:
            points_world: (H, W, 3) surface point at each pixel; NaN for none.
            center_world: The camera's centre (3,).

        A panel is opaque: what appears behind its face, mirrored or seen through glass, is it.
        """
        T_panel_world = invert(self.T_world_panel)
        local = apply(T_panel_world, points_world.reshape(-1, 3)).reshape(points_world.shape)
        return self.labels_local(local, apply(T_panel_world, center_world[None])[0])

    def labels_local(self, local: NDArray, center: Array | None = None) -> NDArray[np.uint8]:
        """As `labels` and, with a camera centre (3,), `labels_seen`, for points (..., 3) in the panel frame."""
        T_body_panel = invert(self.T_panel_body)
        # Coordinate by coordinate: the search of a panel spends its time here.
        x, y, z = (local[..., axis] for axis in range(3))
        body = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in T_body_panel[:3]]
        ours = np.logical_and.reduce(_within(body, self.body_low, self.body_high))
        moves = np.logical_and.reduce(_within([x, y, z], self.low, self.high))
        if center is not None and center[2] > 0:
            behind = ours & (z < 0)
            share = center[2] / (center[2] - z[behind])
            hit = [center[k] + share * (plane[behind] - center[k]) for k, plane in enumerate((x, y))]
            moves[behind] |= np.logical_and.reduce(_within(hit, self.low, self.high))
        labels = np.full(ours.shape, BACKGROUND, np.uint8)
        labels[ours] = STATIC
        labels[moves] = MOVING
        return labels

    def faces(self) -> list[tuple[Array, float]]:
        """The planes of all twelve faces, `normal @ x = offset`, world frame."""
        planes = []
        for T_world_box, low, high in (
            (self.T_world_panel, self.low, self.high),
            (self.T_world_panel @ self.T_panel_body, self.body_low, self.body_high),
        ):
            for axis in range(3):
                normal = T_world_box[:3, axis]
                at_origin = float(normal @ T_world_box[:3, 3])
                planes += [(normal, at_origin + float(edge)) for edge in (low[axis], high[axis])]
        return planes

    @property
    def uncovered_m(self) -> float:
        """How far the panel's corners stand out past the body's footprint, mean over the corners, [m]."""
        corners = [[x, y, 0.0] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])]
        body = apply(invert(self.T_panel_body), np.array(corners))
        beyond = np.maximum(np.maximum(self.body_low - body, body - self.body_high), 0)
        return float(beyond[:, :2].sum(1).mean())


def _within(planes: list[NDArray], low: Array, high: Array) -> list[NDArray[np.bool_]]:
    """For each coordinate, which of its values lie between two bounds (D or more,)."""
    return [(values > low[axis]) & (values < high[axis]) for axis, values in enumerate(planes)]


def panel_frame(
    points_of_views: list[Array], centers_world: Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """Panel frame (4, 4) on the largest plane among the points that the part's boxes show, and their diagonal [m].

    Args:
        points_of_views: Surface points (N, 3) inside the box, one array a view, world frame.
        centers_world: Camera centres (V, 3); the front faces them.
        rng: For the plane search.

    Raises:
        ReconstructionError: The boxes show almost no surface.
    """
    few = min(len(points) for points in points_of_views)
    if not few >= MIN_POINTS:
        raise ReconstructionError(
            STAGE,
            f"a box of the moving part shows {few} pixels of surface, want {MIN_POINTS}",
            "draw it on an image that shows the part",
        )
    count = min(few, 3000)
    points = np.concatenate([p[rng.choice(len(p), count, replace=False)] for p in points_of_views])
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    size = float(np.linalg.norm(high - low))
    normal, origin, near = _plane(points, SCATTER_SHARE * size, rng)
    if (centers_world.mean(0) - origin) @ normal < 0:
        normal = -normal
    up = np.array([0.0, 0.0, 1.0])
    if abs(normal[2]) < np.sin(np.radians(SNAP_DEG)):
        normal = normal * [1, 1, 0] / np.linalg.norm(normal[:2])
    elif abs(normal[2]) > np.cos(np.radians(SNAP_DEG)):
        normal = np.array([0.0, 0.0, np.sign(normal[2])])
        up = np.append(find_upright_axes(near)[:2, 0], 0.0)
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    return transform(np.stack([np.cross(up, normal), up, normal], 1), origin), size


def _plane(points: Array, tolerance: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Unit normal, a point, and the points near the plane that most of them (N, 3) lie on."""
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.sum(normals * corners[:, 0], axis=1)
    counts = (np.abs(points @ normals.T - offsets) < tolerance).sum(0)
    best = int(np.argmax(counts))
    normal, origin = normals[best], corners[best, 0]
    near = points
    for _ in range(3):
        close = np.abs((points - origin) @ normal) < tolerance
        if close.sum() < 3:
            break
        near = points[close]
        origin = near.mean(0)
        normal = np.linalg.svd(near - origin, full_matrices=False)[2][2]
    return normal, origin, near


def cut_at_faces(gaussians: Gaussians, panel: Panel, free: NDArray[np.bool_]) -> Cut:
    """Cut Gaussians whose halves lie in different parts.

    Args:
        gaussians: World frame.
        panel: The boxes.
        free: Which Gaussians (N,) may be cut.
    """
    origins = np.flatnonzero(free)
    pieces, cut = gaussians.select(origins), np.zeros(len(origins), bool)
    for normal, offset in panel.faces():
        crossed = np.flatnonzero(_least_share(pieces, normal, offset) > MIN_SHARE)
        above, below = (_half(pieces.select(crossed), side * normal, side * offset) for side in (1, -1))
        apart = panel.labels(above.means) != panel.labels(below.means)
        divided = crossed[apart]
        whole = np.ones(len(pieces), bool)
        whole[divided] = False
        pieces = concatenate([pieces.select(whole), above.select(apart), below.select(apart)])
        origins = np.concatenate([origins[whole], origins[divided], origins[divided]])
        cut = np.concatenate([cut[whole], np.ones(2 * len(divided), bool)])
    return Cut(sources=origins[cut], pieces=pieces.select(cut))


def _covariances(gaussians: Gaussians) -> Array:
    axes = matrix_from_quat(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    return axes @ np.swapaxes(axes, 1, 2)


def _least_share(gaussians: Gaussians, normal: Array, offset: float) -> Array:
    """Share (N,) of each Gaussian on the emptier side of the plane `normal @ x = offset`."""
    widths = np.linalg.norm(
        gaussians.scales * (normal @ matrix_from_quat(gaussians.quats)).astype(np.float64), axis=1
    )
    return norm.cdf(-np.abs(gaussians.means @ normal - offset) / np.maximum(widths, 1e-12))


def _half(gaussians: Gaussians, normal: Array, offset: float) -> Gaussians:
    """What lies above the plane `normal @ x = offset`, as Gaussians of the same mean and covariance.

    Source: moments of the truncated normal distribution, along the normal.
    """
    covariances = _covariances(gaussians)
    along = covariances @ normal
    variances = along @ normal
    widths = np.sqrt(variances)
    height = (gaussians.means.astype(np.float64) @ normal - offset) / widths
    share = norm.cdf(height)
    shift = norm.pdf(height) / share
    narrowed = 1 - shift * (shift + height)
    means = gaussians.means + (shift / widths)[:, None] * along
    outer = along[:, :, None] * along[:, None, :]
    squares, axes = np.linalg.eigh(covariances - ((1 - narrowed) / variances)[:, None, None] * outer)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    return gaussians_of(
        means=means,
        quats=quat_from_matrix(axes),
        scales=np.sqrt(np.maximum(squares, 0)),
        opacities=np.minimum(gaussians.opacities * share / np.sqrt(narrowed), MAX_OPACITY),
        sh=gaussians.sh,
    )
