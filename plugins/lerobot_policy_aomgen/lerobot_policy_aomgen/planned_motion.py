"""Motion of one episode of `handle_plan`, which follows a plan and yields to the object."""

import numpy as np

from aomgen.core.episode import PHASES
from aomgen.core.plan import EpisodePlan
from aomgen.core.values import Array
from aomgen.evaluation.policies import choose_planned_action

CONTACT = PHASES.index("contact")
# Share of the excessive deviation by which one correction shifts the actions.
GAIN = 0.5
# Largest norm of a deviation of the joints that is not corrected, [rad].
TOLERATED = 0.01


class PlannedMotion:
    """Motion of one episode.

    Args:
        plan: The plan that is followed.
    """

    def __init__(self, plan: EpisodePlan) -> None:
        self.plan = plan
        self._steps = np.gradient(plan.joints, axis=0)
        self._frame, self._offset = 0, np.zeros(plan.joints.shape[1])

    def correct(self, joints: Array) -> None:
        """Shift the further actions according to the measured joints (J,), so that the arm yields to the object.

        The path of the handle differs from the estimated one. The difference between measured and commanded joints is proportional
        to the torques. During the contact, the part of it that is orthogonal to the planned motion does no work, but presses
        against the hinge or the slide. It is corrected where it is large: without a tolerance, the gripper would slowly slip off.
        """
        plan = self.plan
        if self._frame >= len(plan) or plan.phases[self._frame] != CONTACT:
            return
        deviation = joints - plan.joints[self._frame] - self._offset
        step = self._steps[self._frame]
        along = deviation @ step / max(step @ step, 1e-12)
        pressing = deviation - along * step
        excess = max(1.0 - TOLERATED / max(float(np.linalg.norm(pressing)), 1e-12), 0.0)
        self._offset = self._offset + GAIN * excess * pressing

    def next_action(self) -> Array:
        """Return the next action (J + 1,); after the end of the plan, the last one."""
        action = choose_planned_action(self.plan, self._frame, "joint")
        self._frame += 1
        return action + np.append(self._offset, 0.0)

    def list_actions(self) -> Array:
        """List all actions (N, J + 1) of the plan, without corrections."""
        return np.stack([choose_planned_action(self.plan, frame, "joint") for frame in range(len(self.plan))])
