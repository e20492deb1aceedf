"""Which columns a dataset holds, and how they follow from an episode."""

import numpy as np

from aomgen.core.episode import Episode
from aomgen.core.transforms import invert, quat_from_matrix, rotvec_from_matrix
from aomgen.core.values import Array

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_DELTA = ("dx", "dy", "dz", "drx", "dry", "drz")


def feature_names(episode: Episode) -> dict[str, tuple[str, ...]]:
    """Element names of every low-dimensional feature."""
    state = (*episode.joint_names, "gripper")
    return {
        "observation.state": state,
        "observation.ee_pose": _POSE,
        "observation.object_joint": ("theta",),
        "observation.finger_contact": ("left", "right"),
        "action": state,
        "action.ee_absolute": (*_POSE, "gripper"),
        "action.ee_delta": (*_DELTA, "gripper"),
    }


def feature_columns(episode: Episode) -> dict[str, Array]:
    """Values (T, D) of every low-dimensional feature; lengths in metres, angles in radians.

    `action` holds absolute joint targets, `action.ee_absolute` the same target as a pose in
    the world frame, `action.ee_delta` the motion from the observed to the target pose, in the
    observed end effector's frame (translation, then rotation vector). The last element is the
    gripper target, 0 open .. 1 closed. `observation.finger_contact` is each finger's contact
    force [N].
    """
    target = episode.action_gripper[:, None]
    return {
        "observation.state": np.column_stack([episode.joints, episode.gripper]),
        "observation.ee_pose": _pose_vectors(episode.Ts_world_ee),
        "observation.object_joint": episode.thetas[:, None],
        "observation.finger_contact": _finger_forces(episode),
        "action": np.column_stack([episode.action_joints, target]),
        "action.ee_absolute": np.column_stack([_pose_vectors(episode.Ts_world_ee_action), target]),
        "action.ee_delta": np.column_stack([_deltas(episode), target]),
    }


def _pose_vectors(Ts: Array) -> Array:
    """Positions and quaternions wxyz (T, 7), signs chosen so that they never jump."""
    quats = quat_from_matrix(Ts[:, :3, :3])
    if len(quats) and quats[0, 0] < 0:
        quats[0] *= -1
    flips = np.sign(np.einsum("td,td->t", quats[1:], quats[:-1]))
    quats[1:] *= np.cumprod(np.where(flips == 0, 1, flips))[:, None]
    return np.column_stack([Ts[:, :3, 3], quats])


def _deltas(episode: Episode) -> Array:
    Ts_ee_target = invert(episode.Ts_world_ee) @ episode.Ts_world_ee_action
    return np.column_stack([Ts_ee_target[:, :3, 3], rotvec_from_matrix(Ts_ee_target[:, :3, :3])])


def _finger_forces(episode: Episode) -> Array:
    forces = np.zeros((len(episode), 2))
    contacts = episode.contacts
    np.add.at(forces, (contacts.frames, contacts.fingers), contacts.forces)
    return forces
