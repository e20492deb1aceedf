"""What actions mean: from what a policy says to the joints that the arm shall reach at the next frame.

The three spaces are those of a dataset, see `datasets.features`.
"""

import numpy as np

from aomgen.core.plan import EpisodePlan
from aomgen.core.transforms import matrix_from_quat, quat_from_matrix, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ActionSpace, ee_deltas, ee_targets
from aomgen.episodes.ik import IkSolver, converge
from aomgen.errors import ConfigError

# Asked poses are met to [m] and [rad], in at most so many steps. Near a straight elbow 0.2 mm of the hand are 6 degrees of it:
# an arm that lags behind by them catches up with all its torque.
CLOSE, ITERATIONS = (1e-5, 1e-4), 50


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


class Targets:
    """What the robot is to reach in a trial, one target after the other.

    Args:
        space: What actions mean.
        solver: Of the arm.
        start: Joints and gripper (J + 1,) at rest.

    Attributes:
        last: The last target (J + 1,); its branch of the arm is kept.
    """

    def __init__(self, space: ActionSpace, solver: IkSolver, start: Array) -> None:
        self._space, self._solver, self.last = space, solver, start
        # As it was asked for: deltas add up to the path, not to what the solver leaves of it.
        self._T_world_last = solver.robot.ee_poses(start[None, :-1])[0]

    def take(self, action: Array) -> Array | None:
        """Arm joints and gripper (J + 1,) that an action asks for, within the joints' limits; None where it says nothing.

        Beyond the arm's reach it comes as near as it can.
        """
        if not np.isfinite(action).all():
            return None
        low, high = self._solver.robot.joint_limits.T
        gripper = np.clip(action[-1:], 0.0, 1.0)
        if self._space == "joint":
            self.last = np.append(np.clip(action[:-1], low, high), gripper)
            return self.last
        if self._space == "ee_delta":
            T = ee_targets(self._T_world_last[None], action[None, :6])
        elif action[3:7].any():
            quat = action[3:7] / np.linalg.norm(action[3:7])
            T = transform(matrix_from_quat(quat[None]), action[None, :3])
        else:
            return None
        joints = converge(self._solver, T, self.last[None, :-1], ITERATIONS, CLOSE)[0]
        self.last, self._T_world_last = np.append(joints, gripper), T[0]
        return self.last


def choose_planned_action(plan: EpisodePlan, frame: int, space: ActionSpace) -> Array:
    """The action of a plan at a frame, which names what is to be reached at the next; after the end, where to stay."""
    now, ahead = (min(row, len(plan) - 1) for row in (frame, frame + 1))
    target, gripper = plan.Ts_world_ee[ahead], plan.gripper[ahead]
    if space == "joint":
        return np.append(plan.joints[ahead], gripper)
    if space == "ee_delta":
        return np.append(ee_deltas(plan.Ts_world_ee[now][None], target[None])[0], gripper)
    return np.concatenate([target[:3, 3], quat_from_matrix(target[:3, :3]), [gripper]])
