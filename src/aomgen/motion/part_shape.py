"""Shape of the parts: priors of the joint, and whether its motion opened or closed the object.

The shape is a weak prior of the joint, never a decision. Joints run along edges: a hinge lies along one side
of the part that it carries, somewhere in its thickness; a drawer runs along an edge. The gripper's path
decides which side it is, and whether the rule holds at all: every hypothesis has its prior probability.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from aomgen.core.boxes import MIN_POINTS, OrientedBox, find_upright_axes, fit_box
from aomgen.core.joint import Joint
from aomgen.core.motion import Direction
from aomgen.core.transforms import apply, make_tangent_basis, matrix_from_rotvec
from aomgen.core.values import Array, Vector3, freeze_arrays

# Prior probability that a joint lies along a side of the part; is parallel to
# its edges, but elsewhere; neither.
P_ON_EDGE, P_ALONG_EDGE, P_FREE = 0.75, 0.15, 0.1
# Direction of a reconstructed box relative to the object: alignment tilts by 0.3 deg, yaw of a partly seen
# footprint has an error of 0.2 to 1.5 deg.
DIRECTION_SD_RAD = float(np.radians(0.8))
# Hinges lie up to a centimeter inside the side; the error of its reconstruction is about as large, [m].
SIDE_SD_M = 0.01
# Another box is preferred only if its volume is smaller than this share of the upright one's.
_CLEARLY = 0.75
# The walls of a body are at most this far outside the sides of its door or drawer, [m].
_BESIDE_M = 0.02
# A part that leaves the body protrudes by at least this share of its travel;
# one that slides within it does not.
_LEAVING_SHARE = 0.2
# Number of cells of a sliding panel along its longer side.
_CELLS = 12
# Points beyond this percentile on either side are outliers, [%].
_TAIL_PERCENT = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisPrior:
    """One hypothesis of the joint's axis, world frame.

    Attributes:
        axis, axis_sd_rad: Unit direction, either sign, and its standard deviation in each
            direction, infinite if unknown.
        at: A point near the line, [m].
        across, across_sds_m: Directions in which the line's position is known, none or two,
            and standard deviations.
        probability: Prior probability.
    """

    axis: Vector3
    axis_sd_rad: float
    at: Vector3
    across: Annotated[Array, "M 3"]
    across_sds_m: Annotated[Array, "M"]
    probability: float

    __post_init__ = freeze_arrays

    def residuals(self, axes: Array, points: Array) -> Array:
        """Compute deviations (..., 2 + M) of lines from this hypothesis, in standard deviations.

        Args:
            axes: Unit directions (..., 3), either sign.
            points: Points on the lines (..., 3), [m].
        """
        along = axes @ self.axis
        side = np.where(along < 0, -1.0, 1.0)
        tilt = (axes @ make_tangent_basis(self.axis).T) * side[..., None] / self.axis_sd_rad
        offsets = points - self.at
        steep = side * np.maximum(np.abs(along), 0.1)
        offsets = offsets - axes * ((offsets @ self.axis) / steep)[..., None]
        return np.concatenate([tilt, offsets @ self.across.T / self.across_sds_m], axis=-1)

    @property
    def log_density(self) -> float:
        """Log density at zero residuals; a standard deviation of a radian or more is any direction."""
        direction = -np.log(4 * np.pi * min(self.axis_sd_rad, 1.0) ** 2)
        place = -np.log(np.sqrt(2 * np.pi) * self.across_sds_m).sum()
        return float(np.log(self.probability) + direction + place)


# Uninformative hypothesis.
UNIFORM_PRIOR = AxisPrior(
    axis=np.array([0.0, 0.0, 1.0]),
    axis_sd_rad=np.inf,
    at=np.zeros(3),
    across=np.zeros((0, 3)),
    across_sds_m=np.zeros(0),
    probability=P_FREE,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartShape:
    """The moving part's box and quantities derived from it, world frame.

    Attributes:
        box: Box around the part at its scanned pose; its axes need not be upright.
        face_normal: Unit direction in which the part protrudes from the static one.
        corners: Corners of the upright box around both parts, [m].
    """

    box: OrientedBox
    face_normal: Vector3
    corners: Annotated[Array, "8 3"]

    __post_init__ = freeze_arrays

    def reach_m(self, point: Array) -> float:
        """Compute the distance of the object's farthest corner from a point (3,), [m]."""
        return float(np.linalg.norm(self.corners - point, axis=1).max())

    def revolute_priors(self) -> list[AxisPrior]:
        """List hypotheses for a revolute joint: four sides per direction of the box, or a direction alone."""
        hints = [self._direction(k, P_ALONG_EDGE / 3) for k in range(3)]
        for k in range(3):
            for side in (axis for axis in range(3) if axis != k):
                hints += [self._side(k, side, sign) for sign in (-1.0, 1.0)]
        return hints

    def prismatic_priors(self) -> list[AxisPrior]:
        """List hypotheses for a prismatic joint: along one of the three directions."""
        return [self._direction(k, (P_ON_EDGE + P_ALONG_EDGE) / 3) for k in range(3)]

    def _direction(self, k: int, probability: float) -> AxisPrior:
        axis = self.box.T_world_box[:3, k]
        return replace(UNIFORM_PRIOR, axis=axis, axis_sd_rad=DIRECTION_SD_RAD, probability=probability)

    def _side(self, k: int, side: int, sign: float) -> AxisPrior:
        depth = 3 - k - side
        R, half = self.box.T_world_box[:3, :3], self.box.half_extents
        return AxisPrior(
            axis=R[:, k],
            axis_sd_rad=DIRECTION_SD_RAD,
            at=self.box.T_world_box[:3, 3] + sign * half[side] * R[:, side],
            across=R[:, [side, depth]].T,
            # The axis may be anywhere in the thickness: standard deviation of a uniform distribution.
            across_sds_m=np.array([SIDE_SD_M, np.hypot(half[depth] / np.sqrt(3), SIDE_SD_M)]),
            probability=P_ON_EDGE / 12,
        )


def measure_shape(points_static: Array, points_moving: Array) -> PartShape:
    """Measure the box of the moving part and the direction in which it protrudes.

    The box is upright and shares its yaw with the whole object, unless another one is clearly
    smaller: a door ajar has its own yaw, a lid or an object on a slope is tilted.
    Args:
        points_static, points_moving: Points of the parts as scanned (N, 3), (M, 3), world frame, [m].

    Raises:
        InputError: A part has fewer than 20 points.

    Not checked: that the points show the whole part.
    """
    everything = np.concatenate([points_static, points_moving])
    axes = find_upright_axes(everything)
    together, around = fit_box(points_moving, axes), fit_box(everything, axes)
    best = together
    for box in (
        fit_box(points_moving, find_upright_axes(points_moving)),
        _leaning_box(points_moving, together),
    ):
        if _volume(box) < _CLEARLY * _volume(best):
            best = box
    static = fit_box(_beside(points_static, best), best.T_world_box[:3, :3])
    return PartShape(box=best, face_normal=find_face_normal(static, best), corners=around.corners())


def find_face_normal(static: OrientedBox, moving: OrientedBox) -> Array:
    """Find the box axis along which the moving part protrudes most, relative to its size."""
    offset = moving.coordinates(static.T_world_box[:3, 3])
    depth = np.abs(offset) / (static.half_extents + moving.half_extents)
    axis = int(np.argmax(depth))
    return -np.sign(offset[axis]) * moving.T_world_box[:3, axis]


def _beside(points_static: Array, box: OrientedBox) -> Array:
    """Select static points (N, 3) that are before, behind, next to, over or under the part's box.

    Another door of the same object that is ajar must not affect this one's face.
    """
    inside = np.abs(box.coordinates(points_static)) <= box.half_extents + _BESIDE_M
    near = points_static[inside.sum(1) >= 2]
    return near if len(near) >= MIN_POINTS else points_static


def _leaning_box(points: Array, upright: OrientedBox) -> OrientedBox:
    """Find a small box of any orientation from the points' principal directions."""
    main = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    R_main = main.T * np.array([1.0, 1.0, np.linalg.det(main)])
    found = []
    for R in (R_main, upright.T_world_box[:3, :3]):
        result = minimize(
            lambda turn, R=R: np.log(_volume(fit_box(points, R @ matrix_from_rotvec(turn)))),
            np.zeros(3),
            method="Nelder-Mead",
            options={"initial_simplex": np.vstack([np.zeros(3), 0.2 * np.eye(3)]), "maxfev": 150},
        )
        found.append(fit_box(points, R @ matrix_from_rotvec(result.x)))
    return min(found, key=_volume)


def _volume(box: OrientedBox) -> float:
    """Compute the volume of the box plus 1 cm per side, so that noise of thin parts counts little, [m3]."""
    return float(np.prod(box.half_extents + 0.005))


def infer_direction(joint: Joint, theta: float, points_static: Array, points_moving: Array) -> Direction:
    """Infer whether a part opens or closes as it moves from its scanned state to joint value `theta`.

    A closed part is flush with the body: a door or lid lies on it, a drawer is inside it. A panel
    that slides along the body is always flush; it opens by moving before (or behind) the body's own
    front, and closes by covering an opening.

    Args:
        joint, theta: Joint with value 0 at the scan, world frame; value at the
            end of the motion, [rad] or [m].
        points_static, points_moving: Points of the body (N, 3) and of the part as scanned
            (M, 3), world frame, [m].

    Not checked: a door that swings from half a turn open to a quarter stays at
    the same distance from the body.
    """
    ends = (points_moving, apply(joint.motion(theta), points_moving))
    if joint.type == "revolute":
        tree = cKDTree(points_static)
        first, last = (float(tree.query(points)[0].mean()) for points in ends)
        return "opening" if last >= first else "closing"
    beyond = [_beyond(points @ joint.axis, points_static @ joint.axis) for points in ends]
    if abs(beyond[1] - beyond[0]) >= _LEAVING_SHARE * abs(theta):
        return "opening" if beyond[1] > beyond[0] else "closing"
    return "opening" if _lies_before_front(joint.axis, theta, points_static, points_moving) else "closing"


def _beyond(places: Array, body: Array) -> float:
    """Measure how far positions (M,) are outside the range of the body's (N,) on average, [m]."""
    low, high = np.percentile(body, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    return float(np.maximum(np.maximum(low - places, places - high), 0).mean())


def _lies_before_front(axis: Array, travel_m: float, points_static: Array, points: Array) -> bool:
    """Check whether most of the area that a panel (M, 3) newly covers was already the body's (N, 3) front.

    The area that it uncovers does not count: the scan could not show what was behind the panel.
    """
    across = _thin_direction(points, axis)
    plane = np.stack([axis, np.cross(across, axis)], 1)
    low, high = np.percentile(points @ plane, [_TAIL_PERCENT, 100 - _TAIL_PERCENT], axis=0)
    cell = float((high - low).max()) / _CELLS
    depth = points @ across
    # Two panels run within a cell of each other; a handle does not make the panel thicker.
    near = np.abs(points_static @ across - np.median(depth)) <= cell + np.ptp(np.percentile(depth, [25, 75]))
    shift = np.array([travel_m, 0.0])
    size = np.maximum(np.ceil((high - low + np.abs(shift)) / cell).astype(int), 1)
    low = low + np.minimum(shift, 0.0)

    def cover(places: Array) -> NDArray[np.bool_]:
        cells = np.floor((places - low) / cell).astype(int)
        cells = cells[np.all((cells >= 0) & (cells < size), axis=1)]
        grid = np.zeros(size, bool)
        grid[tuple(cells.T)] = True
        return ndimage.binary_closing(grid)

    start, end = (cover(points @ plane + offset) for offset in (0.0, shift))
    fresh = end & ~start
    return float(cover(points_static[near] @ plane)[fresh].mean()) >= 0.5 if fresh.any() else True


def _thin_direction(points: Array, axis: Array) -> Array:
    """Find the unit direction (3,) across `axis` in which points (M, 3) extend least."""
    offsets = points - points.mean(0)
    flat = offsets - np.outer(offsets @ axis, axis)
    # The direction along the axis has no extent after projection and comes last.
    direction = np.linalg.svd(flat, full_matrices=False)[2][1]
    direction -= (direction @ axis) * axis
    return np.asarray(direction / np.linalg.norm(direction), np.float64)
