"""Where the hand touches the part when the motion begins: one patch a finger.

A part that is between the fingers is held: the patches lie on the pads, where their faces come nearest
to each other over the part. Any other touch pushes: it lies where the hand's surface is near the part
and faces the way the part goes. Fingers that closed on something that the scan hardly saw hold it
anywhere on their pads.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.joint_log import JointLog
from aomgen.core.motion import ContactPatch
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.motion.ee_path import average_poses
from aomgen.motion.grip_contact import Patch, assume_pad_patches, find_grip_patches
from aomgen.motion.gripper_signals import EMPTY_GRIP
from aomgen.motion.push_contact import MIN_WAY_M, find_push_patches
from aomgen.robots.gripper_surface import hand_surface
from aomgen.robots.robot import RobotModel

# Patches are followed this long after the start of the motion, [s].
WINDOW_S = 0.3
# Distance of the points that stand for the part's surface, [m]: as well as surfaces are reconstructed.
SPACING_M = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class PartPath:
    """The part during the first moments of a touch.

    Attributes:
        times_s: Moments (K,), [s].
        Ts_world_part: Transforms (K, 4, 4) that carry the part from its scanned place to where it is then.
    """

    times_s: Array
    Ts_world_part: Array

    def __post_init__(self) -> None:
        freeze(self, "times_s", self.times_s, (None,))
        freeze(self, "Ts_world_part", self.Ts_world_part, (len(self.times_s), 4, 4))

    @staticmethod
    def carried(robot: RobotModel, log: JointLog, resting_s: float, times_s: Array) -> "PartPath":
        """The part as if the hand held it firmly at times (K,) since a time at which it rested."""
        Ts_world_ee = robot.ee_poses(log.at(np.append(resting_s, times_s))[0])
        return PartPath(times_s=times_s, Ts_world_part=Ts_world_ee[1:] @ invert(Ts_world_ee[0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Contacts:
    """Patches, and the held point that follows from them.

    Attributes:
        patches: One a finger; one named "hand" for a robot without known pads.
        grasp_ee: Middle of the patches (3,), end-effector frame, [m].
        grasp_sd_m: Its standard deviation in each direction, [m].
    """

    patches: tuple[ContactPatch, ...]
    grasp_ee: Array
    grasp_sd_m: float

    def __post_init__(self) -> None:
        freeze(self, "grasp_ee", self.grasp_ee, (3,))


def find_contacts(
    robot: RobotModel, log: JointLog, points_moving: Array, axes_world: Array, path: PartPath
) -> Contacts:
    """Patches of all fingers that touch, over the first moments of the motion.

    The part is put where the hand has it: averaged over the path's moments, its place is known better
    than at any one of them, and no patch is sought where the part was a moment ago.

    Args:
        robot: Kinematics, pads and meshes.
        log: The joint log.
        points_moving: Dense points of the part at its scanned place (N, 3), world frame, [m].
        axes_world: Unit axes (3, 3) in rows of the box around the part as scanned.
        path: Where the part is at these moments.

    Source: AOMGen, sec. 4.2, "Contact Point Detection", with patches in place of one nearest pair.
    Not checked: that anything touches at all; `gap_m` tells.
    """
    joints, gripper = log.at(path.times_s)
    Ts_world_ee = robot.ee_poses(joints)
    T_ee_part = average_poses(invert(Ts_world_ee) @ path.Ts_world_part)
    points_ee = apply(T_ee_part, points_moving)
    middle = len(gripper) // 2
    Ts_ee_body = invert(Ts_world_ee[middle]) @ robot.link_poses(joints, gripper)[middle]
    axes_ee = axes_world @ T_ee_part[:3, :3].T
    open_hand = float(np.median(gripper)) < EMPTY_GRIP
    patches = find_grip_patches(robot.pads, Ts_ee_body, points_ee, axes_ee) if open_hand else ()
    if not patches and robot.hand_bodies:
        points, normals = (surface := hand_surface(robot)).posed(Ts_ee_body)
        patches = find_push_patches(
            (points, normals, surface.fingers), points_ee, _way_ee(Ts_world_ee, path.Ts_world_part)
        )
    if not patches:
        closed_on_it = open_hand and len(robot.pads) >= 2
        patches = (
            assume_pad_patches(robot.pads, Ts_ee_body, points_ee) if closed_on_it else (_nearest(points_ee),)
        )
    sd_m = float(np.sqrt(np.mean([patch.covariance.trace() / 3 for patch in patches])))
    return Contacts(
        patches=tuple(_carried(patch, Ts_world_ee) for patch in patches),
        grasp_ee=np.mean([patch.point for patch in patches], axis=0),
        grasp_sd_m=sd_m,
    )


def _way_ee(Ts_world_ee: Array, Ts_world_part: Array) -> Array:
    """Way (3,) of the part at the hand over the path, of the hand if the part rests; end-effector frame, [m]."""
    T_world_ee = Ts_world_ee[len(Ts_world_ee) // 2]
    touched = apply(invert(Ts_world_part[len(Ts_world_part) // 2]), T_world_ee[:3, 3])
    first, last = apply(Ts_world_part[[0, -1]], touched)
    if not np.linalg.norm(last - first) > MIN_WAY_M:
        first, last = Ts_world_ee[[0, -1], :3, 3]
    return T_world_ee[:3, :3].T @ (last - first)


def _carried(patch: Patch, Ts_world_ee: Array) -> ContactPatch:
    """The patch in the world, averaged over the moments in which the hand carries it."""
    normal = (Ts_world_ee[:, :3, :3] @ patch.normal).mean(0)
    return ContactPatch(
        finger=patch.finger,
        point=apply(Ts_world_ee, patch.point).mean(0),
        normal=normal / np.linalg.norm(normal),
        spread_m=patch.spread_m,
        gap_m=patch.gap_m,
    )


def _nearest(points_ee: Array) -> Patch:
    """The part's point nearest to the end effector, for a robot whose hand is not known."""
    gap, index = cKDTree(points_ee).query(np.zeros(3))
    point = points_ee[index]
    normal = point / gap if gap > 1e-6 else np.array([0.0, 0.0, 1.0])
    return Patch(finger="hand", point=point, normal=normal, covariance=np.eye(3) * gap**2, gap_m=float(gap))
