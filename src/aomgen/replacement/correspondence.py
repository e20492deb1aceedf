"""Correspondence of an asset and the recorded object: front, held point and the path of that point.

Source: AOMGen, sec. 4.3, "Physical Interaction Adaptation" (the NOCS-like contact map). The paper
normalizes both parts to axis-aligned unit cubes; here the cubes are aligned with the fronts of the
objects, and an asset with a named handle is held at this handle.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.signal import savgol_filter

from aomgen.assets.asset_check import MAX_HANDLE_THICKNESS
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.boxes import QUANTILES, find_upright_axes
from aomgen.core.demonstration import Demonstration, RecordedObject
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.motion import Direction
from aomgen.core.transforms import angle_between, apply, transform
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.errors import EstimationError

# World frame, z up.
UP: Final = np.array([0.0, 0.0, 1.0])
# Least horizontal share of the first motion step from which the front is determined; with a smaller share
# the part opens upwards (a lid).
MIN_LEVEL: Final = 0.5
# Largest angle between the normal of the front and the opening direction, [rad]; less than 45 degrees, at which two
# sides of the box are equally near.
MAX_FRONT_CORRECTION_RAD: Final = np.deg2rad(25.0)
# Length at both ends of a handle's bar that is not grasped, so that the pads do not touch its posts, [m].
BAR_MARGIN_M: Final = 0.03
# Length of the finger pads, [m].
PAD_LENGTH_M: Final = 0.02
# Colliders with a smaller distance belong to one handle, [m].
TOUCH_M: Final = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedContact:
    """The recorded motion from closed to open, as the fit uses it; a closing motion is reversed in time.

    Attributes:
        direction: Direction of the recorded motion.
        path_world: Path (K, 3) of the held point while the part moves, [m].
        shares: Normalized time (K,) of each point, 0..1.
        thetas: Recovered joint values (K,), [rad] or [m]; they begin at 0 and do not decrease.
        R_world_front: Upright frame of the recorded object's front; its columns point right, into the object, and up.
            The frame of an asset has the same convention, because its front points along -y.
        opens_left: Whether the part, viewed from the front, rotates about its left side or slides to the left.
        held_share: Held point (3,) in the normalized cube of the moving part, along right, inward, up.
        size: Extent (3,) of the moving part along these axes, [m].
        support_z: Height of the support plane, [m].
    """

    direction: Direction
    path_world: Annotated[Array, "K 3"]
    shares: Annotated[Array, "K"]
    thetas: Annotated[Array, "K"]
    R_world_front: Annotated[Array, "3 3"]
    opens_left: bool
    held_share: Vector3
    size: Vector3
    support_z: float

    __post_init__ = freeze_arrays

    @property
    def yaw(self) -> float:
        """Rotation about the vertical from the axes of an asset to those of the front, [rad]."""
        return float(np.arctan2(self.R_world_front[1, 0], self.R_world_front[0, 0]))


def describe_contact(demo: Demonstration, recorded: RecordedObject, direction: Direction) -> RecordedContact:
    """Describe the contact of the demonstration and the front of the recorded object.

    An opening is assumed to begin at the closed object, and a closing to end there.

    Raises:
        EstimationError: The part's front is ambiguous (see `find_front`).
    """
    frames = demo.contact_frames
    joint, moving, thetas, times = demo.joint, recorded.moving_points_world, demo.thetas, demo.times_s
    if direction == "closing":
        frames = frames[::-1]
        closed = float(thetas[frames[0]])
        moving = apply(joint.motion(closed), moving)
        joint, thetas, times = replace(joint, axis=-joint.axis), closed - thetas, -times
    Ts_world_ee, grasp = demo.Ts_world_ee[frames], demo.grasp_ee
    # The box is fitted to both parts, because a door with its handle is box-like less often.
    held = apply(Ts_world_ee[0], grasp)
    R = find_front(joint, held, np.concatenate([moving, recorded.static_points_world]))
    low, high = np.quantile(moving @ R, QUANTILES, axis=0)
    beyond = measure_rim_distance(held @ R, R.T @ Ts_world_ee[0, :3, :3], low, high)
    path = apply(Ts_world_ee, (grasp + [0.0, 0.0, beyond])[None])
    size, since = high - low, times[frames] - times[frames[0]]
    return RecordedContact(
        direction=direction,
        path_world=path,
        shares=since / max(since[-1], 1e-9),
        thetas=smooth_rise(thetas[frames]),
        R_world_front=R,
        opens_left=opens_left(joint, held, R[:, 0]),
        held_share=(path[0] @ R - low) / np.maximum(size, 1e-6),
        size=size,
        support_z=recorded.support.height,
    )


def measure_rim_distance(held: Array, R_front_ee: Array, low: Array, high: Array) -> float:
    """Measure the distance from a held point to the rim of a thin part, along the pads, [m]; 0 if no rim is held.

    A rim is between the pads, but its position along them is uncertain, so the point is moved onto the part. If the
    part is thicker than the opening of the fingers, they hold a handle, which may be outside of the part's box.

    Args:
        held: Recorded held point (3,), upright front frame, [m].
        R_front_ee: Orientation of the end effector (3, 3) in that frame; z is the approach direction, and the fingers
            close along y.
        low, high: Corners of the part's box (3,), the same frame.
    """
    closing, approach = (np.where(np.abs(d) < 1e-9, 1e-9, d) for d in (R_front_ee[:, 1], R_front_ee[:, 2]))
    if not np.min((high - low) / np.abs(closing)) <= MAX_HANDLE_THICKNESS:
        return 0.0
    ends = np.sort(np.stack([low - held, high - held]) / approach, axis=0)
    enters, leaves = float(ends[0].max()), float(ends[1].min())
    return enters if 0.0 < enters <= min(PAD_LENGTH_M, leaves) else 0.0


def smooth_rise(thetas: Array) -> Array:
    """Return the nearest non-decreasing curve to noisy joint values (K,), smoothed and starting at 0."""
    window = min(7, len(thetas) - (len(thetas) + 1) % 2)
    smooth = savgol_filter(thetas, window, 2) if window >= 5 else np.asarray(thetas, np.float64)
    smooth = smooth.copy()
    smooth[0], smooth[-1] = thetas[0], max(thetas[-1], smooth[-1])
    rising = isotonic_regression(smooth).x
    return rising - rising[0]


def opening_direction(joint: Joint, held_point: Array) -> Array:
    """Compute the unit direction (3,) in which the held point starts to move, in the joint's frame.

    Raises:
        EstimationError: The point is on the joint axis.
    """
    if joint.type == "prismatic":
        return joint.axis
    direction = np.cross(joint.axis, held_point - joint.origin)
    length = float(np.linalg.norm(direction))
    if not length > 1e-6:
        raise EstimationError(
            "joint", "the held point is on the joint axis", "check the contact and the joint"
        )
    return np.asarray(direction / length, np.float64)


def find_front(joint: Joint, held: Array, points: Array) -> Array:
    """Find the upright frame (3, 3) of an object's front, see `RecordedContact`, from its opening direction and points.

    A part with a vertical hinge starts to move out of its front. Because a handle protrudes from its door, the
    direction of this motion deviates by a few degrees; therefore the side of the smallest upright box around the
    points (N, 3) that is nearest to this direction is used, if one is within 25 degrees. A horizontal hinge (lid,
    flap) is parallel to the front. A sliding part moves out of the front or along it; the front is then the side from
    which the held point protrudes farthest. All arguments are in one frame with z up, with the part closed.

    Raises:
        EstimationError: The part opens neither forward nor sideways, and does not rotate up about a side.
    """
    outward = opening_direction(joint, held)
    if np.linalg.norm(outward[:2]) < MIN_LEVEL:
        if joint.type == "prismatic":
            raise EstimationError("joint", "a part that moves straight up has no front", "give another part")
        arm = held - joint.origin
        outward = arm - joint.axis * (arm @ joint.axis)
    front = np.array([outward[0], outward[1], 0.0])
    front /= np.linalg.norm(front)
    if joint.type == "prismatic":
        front = _standing_out(front, held, points)
    elif _upright(joint):
        front = _nearest_box_side(front, points)
    inward = -front
    right = np.asarray(np.cross(inward, UP), np.float64)
    return np.stack([right, inward, UP], 1)


def opens_left(joint: Joint, held_point: Array, right: Array) -> bool:
    """Return whether a part, viewed from the front, rotates about its left side or slides to the left.

    The result is False for parts that a reflection does not change (drawer, lid, flap). `right` is a unit vector (3,).
    """
    if joint.type == "prismatic":
        return bool(joint.axis @ right < -MIN_LEVEL)
    return _upright(joint) and bool((joint.origin - held_point) @ right < 0)


def face_sides(joint: Joint, held_point: Array) -> list[int]:
    """Select the two of the axes right, inward and up along which the scanned size of a part is reliable.

    For a part that opens forward or sideways these are width and height, because its depth is only partly visible.
    For a lid they are width and depth, because a thin lid is reconstructed several times too thick.
    """
    return [0, 1] if np.linalg.norm(opening_direction(joint, held_point)[:2]) < MIN_LEVEL else [0, 2]


def held_point_of(asset: ArticulatedAsset, recorded_share: Array) -> Array:
    """Compute the point (3,) of an asset that corresponds to the recorded held point, asset frame, part closed.

    `recorded_share` (3,) is the recorded point in the normalized cube of its part, along right, inward, up. The
    position along the axis of the handle is preserved as far as handle and pads permit.

    Not checked: the bar of a bent handle is assumed to be parallel to `handle_axis` everywhere.
    """
    low, high = asset.moving.bounds
    mapped = low + np.clip(recorded_share, 0, 1) * (high - low)
    return slide_along_handle(asset, float((mapped - asset.handle_point) @ asset.handle_axis))


def slide_along_handle(asset: ArticulatedAsset, along_m: float) -> Array:
    """Compute the point (3,) on the handle at a distance from `handle_point` along its axis, asset frame.

    The distance is limited by the space for the pads. The point follows the colliders of a bent handle.
    """
    reach = bar_reach(asset)
    along = float(np.clip(along_m, -reach, reach))
    middles, spans = _handle_spans(asset)
    off = np.maximum(spans[:, 0] - along, along - spans[:, 1])
    held = 0 if off[0] <= 0 else int(np.argmin(off))
    bend = middles[held] - middles[0]
    return asset.handle_point + bend + (along - bend @ asset.handle_axis) * asset.handle_axis


def bar_reach(asset: ArticulatedAsset) -> float:
    """Compute the largest distance from `handle_point` along the handle at which a gripper can hold it, [m]."""
    _, spans = _handle_spans(asset)
    low, high = spans[0]
    for _ in spans:
        joined = spans[(spans[:, 0] <= high + TOUCH_M) & (spans[:, 1] >= low - TOUCH_M)]
        low, high = joined[:, 0].min(), joined[:, 1].max()
    return max(float(min(-low, high)) - BAR_MARGIN_M, 0.0)


def _handle_spans(asset: ArticulatedAsset) -> tuple[Array, Array]:
    """Return centers (B, 3) of the handle's boxes, sorted by distance from `handle_point`, and their spans (B, 2).

    A span is the lowest and highest coordinate along the handle axis, relative to `handle_point`, [m]. If no box is
    named as a handle, the nearest moving box is used.
    """
    named = asset.handle_boxes
    boxes = sorted(named or asset.moving.colliders, key=lambda box: box.distance(asset.handle_point))
    boxes = boxes if named else boxes[:1]
    heights = np.array([(box.corners - asset.handle_point) @ asset.handle_axis for box in boxes])
    middles = np.array([box.T_asset_box[:3, 3] for box in boxes])
    return middles, np.stack([heights.min(1), heights.max(1)], 1)


def mirror_asset(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Reflect the asset in x, so that the hinge changes sides.

    The winding of faces is reversed, and textures remain on their faces, so text is mirrored. The axis of a revolute
    joint is transformed as a pseudo-vector, so the opening direction remains positive.
    """
    M = np.diag([-1.0, 1.0, 1.0])
    sign = -1.0 if asset.joint.type == "revolute" else 1.0
    joint = replace(asset.joint, axis=sign * M @ asset.joint.axis, origin=M @ asset.joint.origin)
    return replace(
        asset,
        static=_mirror_link(asset.static, M),
        moving=_mirror_link(asset.moving, M),
        joint=joint,
        handle_point=M @ asset.handle_point,
        handle_axis=M @ asset.handle_axis,
    )


def _mirror_link(link: AssetLink, M: Array) -> AssetLink:
    def mesh(source: Mesh) -> Mesh:
        return replace(
            source, vertices=source.vertices @ M, faces=source.faces[:, ::-1], uvs=source.uvs[:, ::-1]
        )

    # A box is symmetric, so reflecting its axes as well gives a proper rotation.
    colliders = tuple(
        replace(box, T_asset_box=transform(M @ box.T_asset_box[:3, :3] @ M, M @ box.T_asset_box[:3, 3]))
        for box in link.colliders
    )
    return replace(link, meshes=tuple(mesh(item) for item in link.meshes), colliders=colliders)


def _upright(joint: Joint) -> bool:
    return bool(abs(joint.axis @ UP) > MIN_LEVEL)


def _standing_out(way: Array, held: Array, points: Array) -> Array:
    """Choose, of the directions along and across a horizontal direction (3,), the one in which `held` is outermost."""
    across = np.cross(way, UP)
    sides = [way, across, -across, -way]
    beyond = [float(held @ side - np.percentile(points @ side, 98)) for side in sides]
    return sides[int(np.argmax(beyond))]


def _nearest_box_side(level: Array, points: Array) -> Array:
    """Return the side normal (3,) of the smallest upright box that is nearest to `level`; `level` if none is near."""
    axis, normal = find_upright_axes(points)[:2, :2].T
    sides = [s * d for d in (axis, normal) for s in (-1.0, 1.0)]
    side = np.append(max(sides, key=lambda d: float(d @ level[:2])), 0.0)
    return side if angle_between(side, level) <= MAX_FRONT_CORRECTION_RAD else level
