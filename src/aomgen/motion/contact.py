"""Where the fingers touch the part when the motion begins: one patch a finger."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.joint_log import JointLog
from aomgen.core.motion import ContactPatch
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.motion.hand import box_faces, pad_face
from aomgen.physics.robot import FingerPad, RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactParams:
    """How patches are cut out.

    Attributes:
        window_s: The patch is followed this long after the start of the motion, [s].
        steps: Moments in that window.
        patch_sd_m: Pad points count by their distance to the part, with this spread, [m].
    """

    window_s: float = 0.3
    steps: int = 7
    patch_sd_m: float = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class Contacts:
    """Patches, and the held point that follows from them.

    Attributes:
        patches: One a finger; one named "hand" for a robot without known pads.
        grasp_ee: Middle of the patches (3,), end-effector frame, [m].
    """

    patches: tuple[ContactPatch, ...]
    grasp_ee: Array

    def __post_init__(self) -> None:
        freeze(self, "grasp_ee", self.grasp_ee, (3,))


def find_contacts(
    robot: RobotModel,
    log: JointLog,
    points_moving: Array,
    start_log_s: float,
    params: ContactParams | None = None,
) -> Contacts:
    """Patches of all fingers over the first moments of the motion.

    The patch is found at the start, when the part still stands where it was scanned, on the finger's
    surface (known to a millimetre) rather than on the reconstructed part; then the finger carries it.

    Args:
        robot: Kinematics and pads.
        log: The joint log.
        points_moving: Points of the part at its scanned place (N, 3), world frame, [m].
        start_log_s: Start of the motion, log clock, [s].
        params: Sizes.

    Source: AOMGen, sec. 4.2, "Contact Point Detection", with a patch in place of one nearest pair.
    Not checked: that a finger without a part near it touches at all; `gap_m` tells.
    """
    params = params or ContactParams()
    joints, gripper = log.at(start_log_s + np.linspace(0, params.window_s, params.steps))
    Ts_world_ee = robot.ee_poses(joints)
    tree = cKDTree(points_moving)
    if not robot.pads:
        return _hand_contact(Ts_world_ee, tree, points_moving)
    bodies = robot.link_poses(joints, gripper)
    between = _holds_something(robot, bodies[0], points_moving)
    patches = tuple(_patch(pad, bodies[:, pad.body], tree, between, params) for pad in robot.pads)
    middles = [_start_point(pad, bodies[0, pad.body], tree, between, params) for pad in robot.pads]
    grasp_world = np.mean(middles, axis=0)
    return Contacts(patches=patches, grasp_ee=apply(invert(Ts_world_ee[0]), grasp_world))


def _patch(
    pad: FingerPad, Ts_world_pad: Array, tree: cKDTree, inner: bool, params: ContactParams
) -> ContactPatch:
    points, normals, weights, gap = _weighted_surface(pad, Ts_world_pad[0], tree, inner, params)
    middle = weights @ points
    normal = weights @ normals
    spread = float(np.sqrt(weights @ ((points - middle) ** 2).sum(1)))
    world = apply(Ts_world_pad, middle).mean(0)
    turned = (Ts_world_pad[:, :3, :3] @ normal).mean(0)
    return ContactPatch(
        finger=pad.finger, point=world, normal=turned / np.linalg.norm(turned), spread_m=spread, gap_m=gap
    )


def _start_point(
    pad: FingerPad, T_world_pad: Array, tree: cKDTree, inner: bool, params: ContactParams
) -> Array:
    points, _, weights, _ = _weighted_surface(pad, T_world_pad, tree, inner, params)
    return apply(T_world_pad, weights @ points)


def _weighted_surface(
    pad: FingerPad, T_world_pad: Array, tree: cKDTree, inner: bool, params: ContactParams
) -> tuple[Array, Array, Array, float]:
    """Surface points (G, 3), normals (G, 3), weights (G,) summing to one, and the smallest gap [m]."""
    if inner:
        points, normal = pad_face(pad)
        normals = np.broadcast_to(normal, points.shape)
    else:
        points, normals = box_faces(pad)
    distances = tree.query(apply(T_world_pad, points))[0]
    nearest = float(distances.min())
    weights = np.exp(-0.5 * (distances**2 - nearest**2) / params.patch_sd_m**2)
    return points, normals, weights / weights.sum(), nearest


def _holds_something(robot: RobotModel, bodies: Array, points_moving: Array) -> bool:
    """Whether part points lie in the space between the pads' inner faces."""
    if len(robot.pads) < 2:
        return False
    first, other = robot.pads
    T_pad_world = invert(bodies[first.body] @ first.T_body_pad)
    top = first.half_extents[2]
    across = apply(T_pad_world @ bodies[other.body], other.face_body)[2] - top
    if not across > 1e-6:
        return False
    local = apply(T_pad_world, points_moving)
    inside = np.all(np.abs(local[:, :2]) < first.half_extents[:2], axis=1)
    return bool((inside & (local[:, 2] > top) & (local[:, 2] < top + across)).any())


def _hand_contact(Ts_world_ee: Array, tree: cKDTree, points_moving: Array) -> Contacts:
    gap, index = tree.query(Ts_world_ee[0, :3, 3])
    point = points_moving[index]
    held = apply(invert(Ts_world_ee[0]), point)
    offset = point - Ts_world_ee[0, :3, 3]
    length = float(np.linalg.norm(offset))
    normal = offset / length if length > 1e-6 else Ts_world_ee[0, :3, 2]
    patch = ContactPatch(
        finger="hand", point=apply(Ts_world_ee, held).mean(0), normal=normal, spread_m=0.0, gap_m=float(gap)
    )
    return Contacts(patches=(patch,), grasp_ee=held)
