"""What actions mean: from what a policy says to the joints that the arm shall reach at the next frame.

The three spaces are those of a dataset, see `datasets.features`.
"""

from typing import Final, get_args

import numpy as np

from aomgen.core.plan import EpisodePlan
from aomgen.core.transforms import matrix_from_quat, quat_from_matrix, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ActionSpace, ee_deltas, ee_targets
from aomgen.episodes.ik import IkSolver, converge
from aomgen.episodes.joint_limits import IkLimits
from aomgen.errors import ConfigError
from aomgen.simulation.replay import Reached

ACTION_SPACES: Final[tuple[ActionSpace, ...]] = get_args(ActionSpace)


def action_size(space: ActionSpace, arm_joints: int) -> int:
    """How many numbers an action has, the gripper's last."""
    return {"joint": arm_joints, "ee_absolute": 7, "ee_delta": 6}[space] + 1


def require_shape(action: Array, size: int) -> None:
    """Refuse what is no action.

    Raises:
        ConfigError: It has not the shape (size,).
    """
    if action.shape != (size,):
        raise ConfigError("action", f"has shape {action.shape}", f"want ({size},), the gripper last")


def joint_target(
    action: Array, space: ActionSpace, solver: IkSolver, reached: Reached, last: Array
) -> Array | None:
    """Arm joints and gripper (J + 1,) that an action asks for, within the joints' limits; None where it says nothing.

    Args:
        action: Of the space's size.
        reached: What the robot measures now; a delta counts from its end effector.
        last: The last target (J + 1,), whose branch of the arm is kept. Beyond the arm's reach it comes as near as it can.
    """
    if not np.isfinite(action).all():
        return None
    low, high = solver.robot.joint_limits.T
    gripper = np.clip(action[-1:], 0.0, 1.0)
    if space == "joint":
        return np.append(np.clip(action[:-1], low, high), gripper)
    if space == "ee_delta":
        Ts = ee_targets(reached.T_world_ee[None], action[None, :6])
    elif action[3:7].any():
        quat = action[3:7] / np.linalg.norm(action[3:7])
        Ts = transform(matrix_from_quat(quat[None]), action[None, :3])
    else:
        return None
    return np.append(converge(solver, Ts, last[None, :-1], IkLimits().iterations)[0], gripper)


def planned_action(plan: EpisodePlan, frame: int, space: ActionSpace, T_world_ee: Array) -> Array:
    """The action of a plan at a frame, which names what is to be reached at the next; after the end, where to stay.

    Args:
        T_world_ee: Where the end effector is (4, 4); a delta counts from there.
    """
    ahead = min(frame + 1, len(plan) - 1)
    target, gripper = plan.Ts_world_ee[ahead], plan.gripper[ahead]
    if space == "joint":
        return np.append(plan.joints[ahead], gripper)
    if space == "ee_delta":
        return np.append(ee_deltas(T_world_ee[None], target[None])[0], gripper)
    return np.concatenate([target[:3, 3], quat_from_matrix(target[:3, :3]), [gripper]])
