"""Requirements on an articulated asset that is simulated and rendered."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from aomgen.assets.mjcf import AssetNames, add_asset
from aomgen.core.asset import ArticulatedAsset, BoxCollider
from aomgen.core.values import Array, Vector3, freeze_arrays

# A ball with this diameter, which represents a fingertip, must fit between handle and front; a handle may not be
# thicker than the second value, because half of the widest supported gripper's stroke is needed by the fingers, [m].
FINGER_BALL, MAX_HANDLE_THICKNESS = 0.012, 0.06
# The smallest useful opening of a joint, [rad] and [m].
MIN_OPENING = {"revolute": np.deg2rad(30.0), "prismatic": 0.10}
# Tolerance for joint limits, which are rounded in files, [rad] or [m].
ROUNDING = 1e-6
# A smaller upper limit indicates that radians in the file were read as degrees, [rad].
TINY_OPENING = 0.12
# Range of the longest side of household furniture and appliances, [m]; a size outside of it indicates a wrong unit.
SIZE_RANGE = (0.05, 3.0)
# Colliders that penetrate each other by less than this do not block a joint, [m].
TOUCH = 2e-4
# Number of joint values at which overlaps are searched; a step is about 4 degrees of a door that opens by 100.
RANGE_SAMPLES = 25


def check_asset(asset: ArticulatedAsset) -> list[str]:
    """List the problems of an asset, one sentence each; the list is empty if the asset can be used.

    Not checked: whether the colliders follow the visible meshes.
    """
    problems = _check_sizes(asset) + _check_joint(asset) + _check_links(asset)
    if problems:
        return problems
    return _check_range(asset) + check_handle(asset)


def outward_normal(asset: ArticulatedAsset) -> Array:
    """Compute the outward unit normal (3,) of the face that carries the handle, asset frame.

    If handle colliders are named, the handle is mounted on the nearest other collider of the moving link, and the
    normal is that box's axis toward the handle. Otherwise the normal is estimated from the initial motion of the
    handle: it is the collider axis closest to that direction, because a hinge is slightly behind the front.
    """
    joint = asset.joint
    body = [box for box in asset.moving.colliders if not box.name.startswith("handle")]
    if body and asset.handle_bar is not None:
        nearest = min(body, key=lambda box: box.distance(asset.handle_point))
        T = nearest.T_asset_box
        local = T[:3, :3].T @ (asset.handle_point - T[:3, 3])
        beyond = np.abs(local) - nearest.half_extents
        best = int(np.argmax(beyond))
        return np.asarray(T[:3, best] * np.sign(local[best]), np.float64)
    if joint.type == "prismatic":
        return joint.axis
    motion = np.cross(joint.axis, asset.handle_point - joint.origin)
    motion = motion / max(float(np.linalg.norm(motion)), 1e-12)
    poses, _ = _stack_boxes(asset.moving.colliders)
    axes = np.concatenate([poses[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3), motion[None]])
    alignments = axes @ motion
    # The motion direction itself is the last candidate; it is chosen only if no box axis is within 30 degrees of it.
    alignments[-1] = np.sign(alignments[-1]) * np.cos(np.deg2rad(30))
    best = int(np.argmax(np.abs(alignments)))
    return np.asarray(axes[best] * np.sign(alignments[best]), np.float64)


def held_at_rim(asset: ArticulatedAsset) -> bool:
    """Return whether the gripper must hold the handle from both sides, because no finger fits behind it.

    Examples are the rim of a laptop's lid and a knob.
    """
    bar = asset.handle_bar
    body = [box for box in asset.moving.colliders if not box.name.startswith("handle")]
    if bar is None or not body:
        return False
    model, data, names = _simulate_touch(asset)
    bar_geom, *others = (model.geom(f"{names.moving_body}_{box.name}").id for box in (bar, *body))
    return any(mujoco.mj_geomDistance(model, data, bar_geom, other, 1.0, None) < TOUCH for other in others)


def _stack_boxes(colliders: Sequence[BoxCollider]) -> tuple[Array, Array]:
    """Stack the poses (B, 4, 4) and half extents (B, 3), [m], of colliders."""
    return np.array([box.T_asset_box for box in colliders]), np.array([box.half_extents for box in colliders])


def _list_failures(*checks: tuple[bool, str]) -> list[str]:
    """Return the sentences of the checks that do not hold."""
    return [sentence for holds, sentence in checks if not holds]


def _check_sizes(asset: ArticulatedAsset) -> list[str]:
    vertices = [mesh.vertices for link in (asset.static, asset.moving) for mesh in link.meshes]
    if not vertices:
        return ["has no meshes"]
    points = np.concatenate(vertices)
    if not np.isfinite(points).all():
        return ["has vertices that are not finite"]
    size, foot = float((points.max(0) - points.min(0)).max()), points[:, 2].min()
    low, high = SIZE_RANGE
    return _list_failures(
        (low <= size <= high, f"is {size:.3g} m large, expected {low} to {high} m: check metersPerUnit"),
        (abs(foot) <= 0.005, f"stands at z = {foot:.3f} m, expected 0"),
    )


def _check_joint(asset: ArticulatedAsset) -> list[str]:
    joint, least = asset.joint, MIN_OPENING[asset.joint.type]
    limits = f"{joint.lower:.3g} .. {joint.upper:.3g}"
    degrees = joint.type == "revolute" and not joint.upper <= 2 * np.pi
    # MuJoCo reads angles as degrees if a file does not state their unit, which is common for partial files.
    opening_deg = float(np.degrees(joint.upper))
    radians = joint.type == "revolute" and joint.upper <= TINY_OPENING and opening_deg <= 2 * np.pi
    hint = (
        f": radians read as degrees? Import it with --limits {np.degrees(joint.lower):.3g} {opening_deg:.3g}, "
        "or farther if it can open farther"
        if radians
        else "; if it can open farther, import it with --limits"
    )
    return _list_failures(
        (bool(abs(np.linalg.norm(joint.axis) - 1) <= 1e-6), "has a joint axis that is not a unit vector"),
        (
            joint.lower <= ROUNDING and joint.upper >= 0.0,
            f"has joint limits {limits} that exclude the closed state 0",
        ),
        (
            joint.upper >= least,
            f"opens by {joint.upper:.3g} only, expected at least {least:.3g} (rad or m){hint}",
        ),
        (
            not degrees,
            f"opens by {joint.upper:.3g} rad: limits look like degrees; import it with --limits "
            f"{np.radians(joint.lower):.3g} {np.radians(joint.upper):.3g}",
        ),
    )


def _check_links(asset: ArticulatedAsset) -> list[str]:
    problems = []
    for link in (asset.static, asset.moving):
        names = [box.name for box in link.colliders]
        thick = all((box.half_extents > 0).all() for box in link.colliders)
        problems += _list_failures(
            (link.mass > 0, f"link {link.name!r} has mass {link.mass}, expected a positive one"),
            (bool(link.meshes), f"link {link.name!r} has no meshes"),
            (bool(names), f"link {link.name!r} has no colliders"),
            (thick, f"link {link.name!r} has a collider without thickness"),
            (len(set(names)) == len(names), f"link {link.name!r} repeats a collider name"),
        )
    return problems


def _check_range(asset: ArticulatedAsset) -> list[str]:
    """List pairs of static and moving colliders that overlap at some joint value, but not in the closed state."""
    found: dict[tuple[str, str], float] = {}
    for overlap in find_overlaps(asset):
        found.setdefault((overlap.static, overlap.moving), overlap.theta)
    return [
        f"colliders {a!r} and {b!r} overlap at joint value {theta:.3g}"
        for (a, b), theta in found.items()
        if theta > 0.0
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """An overlap of two colliders, given by their names, at a joint value.

    Attributes:
        static, moving: Names of the colliders of the static and of the moving link.
        theta: Joint value, [rad] or [m].
        depth: Penetration depth, [m].
        normal: Unit direction (3,) in which the static collider leaves the overlap, asset frame.
    """

    static: str
    moving: str
    theta: float
    depth: float
    normal: Vector3

    __post_init__ = freeze_arrays


def find_overlaps(asset: ArticulatedAsset) -> Iterator[Overlap]:
    """Yield every contact between a static and a moving collider with more than the tolerated depth.

    Contacts are computed at evenly spaced values over the range of the joint.
    """
    model, data, names = _simulate_touch(asset)
    # MuJoCo numbers geoms body by body.
    boxes = [box.name for link in (asset.static, asset.moving) for box in link.colliders]
    count = len(asset.static.colliders)
    for theta in np.linspace(0.0, asset.joint.upper, RANGE_SAMPLES).tolist():
        data.joint(names.joint).qpos[0] = theta
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            if contact.dist < -TOUCH:
                first, second = contact.geom.tolist()
                # The normal points from the first geom to the second.
                sign = -1.0 if first < count else 1.0
                a, b = sorted((first, second))
                yield Overlap(
                    static=boxes[a],
                    moving=boxes[b],
                    theta=theta,
                    depth=-float(contact.dist),
                    normal=sign * contact.frame[:3],
                )


def find_hinged_pairs(asset: ArticulatedAsset) -> set[tuple[str, str]]:
    """Return name pairs (static, moving) of colliders that overlap in the closed state, for example at hinges and seals.

    The links of an object do not collide with each other in simulation, so these overlaps do not block the joint.
    """
    closed = itertools.takewhile(lambda overlap: overlap.theta == 0.0, find_overlaps(asset))
    return {(overlap.static, overlap.moving) for overlap in closed}


def _simulate_touch(asset: ArticulatedAsset) -> tuple[mujoco.MjModel, mujoco.MjData, AssetNames]:
    """Build a MuJoCo model of the closed asset alone in which, unlike in simulation, its links collide with each other."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    names = add_asset(spec, asset, np.eye(4), damping=0.0, frictionloss=0.0)
    spec.delete(spec.excludes[0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data, names


def check_handle(asset: ArticulatedAsset) -> list[str]:
    """List the problems of the handle.

    A moving collider must be at the handle point, the gripper must fit around it, and a finger must fit behind it (or
    on both sides, see `held_at_rim`).
    """
    poses, half = _stack_boxes(asset.moving.colliders)
    point = asset.handle_point
    distances = np.array([box.distance(point) for box in asset.moving.colliders])
    if not distances.min() <= 0.002:
        return [f"handle point lies {1000 * distances.min():.0f} mm off every moving collider"]
    bar = int(np.argmin(distances))
    outward = outward_normal(asset)
    across = np.cross(asset.handle_axis, outward)
    extent = np.abs(poses[bar, :3, :3].T @ np.stack([outward, across], 1))
    depth, thickness = (2 * half[bar] @ extent).tolist()
    rim = held_at_rim(asset)
    sides = np.stack([across, -across]) if rim else -outward[None]
    balls = point + sides * ((thickness if rim else depth) / 2 + FINGER_BALL / 2 + 5e-4)
    others = [box for number, box in enumerate(asset.moving.colliders) if number != bar]
    gap = min(box.distance(ball) for box in (*asset.static.colliders, *others) for ball in balls)
    where = "on both sides of" if rim else "behind"
    mm = 1000
    return _list_failures(
        (
            thickness <= MAX_HANDLE_THICKNESS,
            f"handle is {mm * thickness:.0f} mm thick, limit {mm * MAX_HANDLE_THICKNESS:.0f} mm: import it with a smaller "
            "--scale, or state another place with --handle",
        ),
        (
            bool(gap >= FINGER_BALL / 2),
            f"no {mm * FINGER_BALL:.0f} mm ball fits {where} the handle (free radius {mm * gap:.1f} mm), so no finger does: "
            "state another place with --handle when it is imported",
        ),
    )
