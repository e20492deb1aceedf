"""Model of an articulated object as two boxes: the moving part (a panel) and the body; cuts of Gaussians at its faces.

Segmentation masks of doors, drawers and lids are ragged or end at a window; the boxes have straight borders.
Panel frame: x level along the panel, y up (across, for a lid), z out of the front, origin on the front face.
Body frame: z up.
Gaussians on a plain front are large and extend across the seam around a drawer or a door. With a single label, a strip of the body
would move with the part. A Gaussian that a face intersects is therefore cut in two; each half has the moments of the Gaussian
truncated at the face. The weight is preserved, so the renderings of the scan do not change.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.boxes import find_upright_axes
from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.parts import Cut
from aomgen.core.transforms import (
    apply,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    quat_from_matrix,
    transform,
)
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays
from aomgen.errors import ReconstructionError

STAGE = "parts"
# Largest angle of a front from level or upright at which it is assumed to be level or upright: objects rest on a support, and planes
# have errors of one or two degrees. The angle of lids that are ajar is larger.
SNAP_DEG = 4.0
# Standard deviation of reconstructed surfaces about their plane, as a share of the part's diagonal.
SCATTER_SHARE = 0.015
# Number of RANSAC samples: with a third of inliers, the probability that none is good is far below 1e-9.
TRIALS = 1000
# Least number of surface pixels for the normal of a plane.
MIN_POINTS = 50
# Least share of a Gaussian on either side of a face that cuts it.
MIN_SHARE = 0.1
# Largest opacity: a Gaussian never blocks all light.
MAX_OPACITY = 0.999
# Unknowns of the boxes in a step (13,): left, right, lower and upper edge of the panel; its seam and reach; low and high
# corner of the body, all [m]; yaw of the body about the vertical, [rad].
EDGES, SEAM, REACH, BODY_LOW, BODY_HIGH, YAW, UNKNOWNS = slice(0, 4), 4, 5, slice(6, 9), slice(9, 12), 12, 13


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Two boxes; their intersection belongs to the moving part.

    Attributes:
        low, high: Corners of the moving part, panel frame, [m]. `low[2]` is the seam behind the panel;
            `high[2]` is the reach of handles.
        body_low, body_high: Corners of the object's body, body frame, [m].
    """

    T_world_panel: Matrix4
    low: Vector3
    high: Vector3
    T_panel_body: Matrix4
    body_low: Vector3
    body_high: Vector3

    __post_init__ = freeze_arrays

    def move(self, step: Array) -> "Panel":
        """Add a step (13,) to the unknowns, see `UNKNOWNS`."""
        left, right, lower, upper = step[EDGES]
        turn = transform(matrix_from_rotvec([0, 0, step[YAW]]), np.zeros(3))
        return replace(
            self,
            low=self.low + [left, lower, step[SEAM]],
            high=self.high + [right, upper, step[REACH]],
            T_panel_body=self.T_panel_body @ turn if step[YAW] else self.T_panel_body,
            body_low=self.body_low + step[BODY_LOW],
            body_high=self.body_high + step[BODY_HIGH],
        )

    def thicken_body(self, margin_m: float) -> "Panel":
        """Extend the body on all sides but the lower one, where its support is."""
        return replace(
            self, body_low=self.body_low - [margin_m, margin_m, 0], body_high=self.body_high + margin_m
        )

    def labels(self, points_world: ArrayLike) -> NDArray[np.uint8]:
        """Compute the part labels (N,) of points (N, 3), world frame."""
        return self.labels_local(apply(invert(self.T_world_panel), np.asarray(points_world, np.float64)))

    def labels_seen(self, points_world: Array, center_world: Array) -> NDArray[np.uint8]:
        """Compute the part labels (H, W) of the surface that a camera sees.

        Args:
            points_world: (H, W, 3) surface point at each pixel; NaN for none.
            center_world: The camera's centre (3,).

        A panel is opaque: a surface that appears behind its face, mirrored or through glass, is labelled as panel.
        """
        T_panel_world = invert(self.T_world_panel)
        local = apply(T_panel_world, points_world.reshape(-1, 3)).reshape(points_world.shape)
        return self.labels_local(local, apply(T_panel_world, center_world[None])[0])

    def labels_local(self, local: NDArray, center: Array | None = None) -> NDArray[np.uint8]:
        """Compute the part labels of points (..., 3) in the panel frame: as `labels`, or with a camera center (3,) as
        `labels_seen`.
        """
        T_body_panel = invert(self.T_panel_body)
        # The coordinates are computed separately, because the search of a panel spends most of its time here.
        x, y, z = (local[..., axis] for axis in range(3))
        body = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in T_body_panel[:3]]
        ours = _within(body, self.body_low, self.body_high)
        moves = _within([x, y, z], self.low, self.high)
        if center is not None and center[2] > 0:
            behind = ours & (z < 0)
            share = center[2] / (center[2] - z[behind])
            hit = [center[k] + share * (plane[behind] - center[k]) for k, plane in enumerate((x, y))]
            moves[behind] |= _within(hit, self.low, self.high)
        labels = np.full(ours.shape, BACKGROUND, np.uint8)
        labels[ours] = STATIC
        labels[moves] = MOVING
        return labels

    def faces(self) -> list[tuple[Array, float]]:
        """List the planes `normal @ x = offset` of all twelve faces, world frame."""
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
    def is_valid(self) -> bool:
        """Both boxes have positive sizes, and the front face is between seam and reach."""
        sizes = np.append(self.high - self.low, self.body_high - self.body_low)
        return bool((sizes > 0).all() and self.low[2] < 0 < self.high[2])

    @property
    def extent_m(self) -> float:
        """Sum of the panel's width, height and thickness, and of the body's three sizes, [m]."""
        return float((self.high - self.low)[:2].sum() - self.low[2] + (self.body_high - self.body_low).sum())

    @property
    def skew_rad(self) -> float:
        """Smallest yaw that makes the body square to the panel, [rad], 0..pi/4."""
        along, body = self.T_world_panel[:2, 0], (self.T_world_panel @ self.T_panel_body)[:2, 0]
        yaw = np.arctan2(along[0] * body[1] - along[1] * body[0], along @ body)
        return float(abs((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4))

    @property
    def uncovered_m(self) -> float:
        """Distance of the panel's corners outside the body's footprint, mean over the corners, [m]."""
        corners = [[x, y, 0.0] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])]
        body = apply(invert(self.T_panel_body), np.array(corners))
        beyond = np.maximum(np.maximum(self.body_low - body, body - self.body_high), 0)
        return float(beyond[:, :2].sum(1).mean())


def _within(planes: list[NDArray], low: Array, high: Array) -> NDArray[np.bool_]:
    """Return which points, given one coordinate at a time, lie between two bounds (D or more,)."""
    inside = (planes[0] > low[0]) & (planes[0] < high[0])
    for axis, values in enumerate(planes[1:], 1):
        inside &= values > low[axis]
        inside &= values < high[axis]
    return inside


def find_panel_frame(
    points_of_views: list[Array], centers_world: Array, rng: np.random.Generator
) -> tuple[Array, float]:
    """Find the panel frame (4, 4) on the largest plane among points of the part, and the diagonal of the points, [m].

    Args:
        points_of_views: Surface points (N, 3) inside the box, one array for each view, world frame.
        centers_world: Camera centres (V, 3); the front faces them.
        rng: Generator for the plane search.

    Raises:
        ReconstructionError: The boxes show almost no surface.
    """
    few = min(len(points) for points in points_of_views)
    if not few >= MIN_POINTS:
        raise ReconstructionError(
            STAGE,
            f"a box of the moving part shows {few} pixels of surface, expected {MIN_POINTS}",
            "draw it on an image that shows the part",
        )
    count = min(few, 3000)
    points = np.concatenate([p[rng.choice(len(p), count, replace=False)] for p in points_of_views])
    low, high = np.quantile(points, [0.1, 0.9], axis=0)
    size = float(np.linalg.norm(high - low))
    normal, origin, near = _find_plane(points, SCATTER_SHARE * size, rng)
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


def _find_plane(points: Array, tolerance: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Find the plane near most of the points (N, 3): unit normal, a point, and the points near it."""
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-12)[:, None]
    offsets = np.sum(normals * corners[:, 0], axis=1)
    counts = (np.abs(points @ normals.T - offsets) < tolerance).sum(0)
    # Three corners of which two are the same point determine no plane.
    best = int(np.argmax(np.where(lengths > 0, counts, 0)))
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
    """Cut Gaussians whose halves have different labels.

    Args:
        gaussians: World frame.
        panel: The boxes.
        free: Mask (N,) of the Gaussians that may be cut.
    """
    origins = np.flatnonzero(free)
    pieces, cut = gaussians.select(origins), np.zeros(len(origins), bool)
    for normal, offset in panel.faces():
        crossed = np.flatnonzero(_compute_least_share(pieces, normal, offset) > MIN_SHARE)
        above, below = (_truncate(pieces.select(crossed), side * normal, side * offset) for side in (1, -1))
        apart = panel.labels(above.means) != panel.labels(below.means)
        divided = crossed[apart]
        whole = np.ones(len(pieces), bool)
        whole[divided] = False
        pieces = concatenate([pieces.select(whole), above.select(apart), below.select(apart)])
        origins = np.concatenate([origins[whole], origins[divided], origins[divided]])
        cut = np.concatenate([cut[whole], np.ones(2 * len(divided), bool)])
    return Cut(sources=origins[cut], pieces=pieces.select(cut))


def _compute_least_share(gaussians: Gaussians, normal: Array, offset: float) -> Array:
    """Compute the share (N,) of each Gaussian on the emptier side of the plane `normal @ x = offset`."""
    widths = np.linalg.norm(
        gaussians.scales * (normal @ matrix_from_quat(gaussians.quats)).astype(np.float64), axis=1
    )
    return norm.cdf(-np.abs(gaussians.means @ normal - offset) / np.maximum(widths, 1e-12))


def _truncate(gaussians: Gaussians, normal: Array, offset: float) -> Gaussians:
    """Truncate Gaussians to the upper side of the plane `normal @ x = offset`; mean and covariance are kept.

    Source: moments of the truncated normal distribution, along the normal.
    """
    spread = matrix_from_quat(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    covariances = spread @ np.swapaxes(spread, 1, 2)
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
