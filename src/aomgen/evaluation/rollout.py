"""Closed-loop simulation of one trial: actions, physics, observations and the test for success."""

import math
from functools import cached_property
from typing import Any, Final

import numpy as np

from aomgen.core.demonstration import Trajectory
from aomgen.core.keypoints import find_keypoints, move_keypoints
from aomgen.core.plan import EpisodePlan, Rejection
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.core.values import Array
from aomgen.datasets.features import ActionSpace, ee_targets
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ik import IkSolver, converge
from aomgen.errors import ConfigError
from aomgen.evaluation.suite import Suite, fixed_cameras
from aomgen.evaluation.views import KINDS, Images, TrialViews, Visuals
from aomgen.io.images import resize
from aomgen.results import Results
from aomgen.simulation.judge import PassRule, judge
from aomgen.simulation.replay import Simulation

# Time for which the part has to stay at its target, [s].
HELD_S: Final = 0.5
# Reason of a failure that the pass rule does not define.
BAD_ACTION: Final = "bad_action"
# Tolerances of requested poses, [m] and [rad], and largest number of iterations. Near a straight elbow, 0.2 mm at the
# end effector correspond to 6 degrees at the elbow; an arm corrects such an error with its full torque.
CLOSE, ITERATIONS = (1e-5, 1e-4), 50


class Targets:
    """Targets of the robot in a trial, one after the other.

    Args:
        space: Action space.
        solver: Inverse kinematics solver of the arm.
        start: Joints and gripper (J + 1,) at rest.

    Attributes:
        last: The last target (J + 1,); its branch of the arm is kept.
    """

    def __init__(self, space: ActionSpace, solver: IkSolver, start: Array) -> None:
        self._space, self._solver, self.last = space, solver, start
        # The requested pose, not the solver's result: solver errors must not accumulate in the path of the deltas.
        self._T_world_last = solver.robot.ee_poses(start[None, :-1])[0]

    def take(self, action: Array) -> Array | None:
        """Compute the joint and gripper target (J + 1,) of an action, within the joint limits.

        A pose beyond the arm's reach is approximated. The result is None if the action is not finite or has no
        rotation.
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


class World:
    """Trials of a suite with their common robot, objects and cameras, which are read once.

    Args:
        suite: The trials.
        results: Results of the run of the suite.
        visuals: Renderer of the images.
    """

    def __init__(self, suite: Suite, results: Results, visuals: Visuals = "splat") -> None:
        self.suite, self.visuals = suite, visuals
        fixed = fixed_cameras(suite.cameras, results.robot)
        drawn = {name: camera.resize(*suite.drawn_size) for name, camera in fixed.items()}
        self.factory = EpisodeFactory(results, results.folders["episodes"], drawn)
        self.carried = tuple(name for name in suite.cameras if name not in fixed)
        # The time from the first to the last of these frames is HELD_S.
        self.held_frames = 1 + math.ceil(HELD_S * suite.fps)

    def rollout(self, number: int) -> "Rollout":
        """Return a trial in its initial state."""
        return Rollout(self, number)

    def plan(self, number: int) -> EpisodePlan:
        """Return the plan of a trial that was verified when the trial was sampled."""
        trial = self.suite.trials[number]
        plan = self.factory.plan(self.factory.asset(trial.asset), trial.variation)
        if isinstance(plan, Rejection):
            raise ValueError(f"trial {number} has no plan: {plan.detail}")
        return plan


class Rollout:
    """One trial from its initial state to its end.

    Attributes:
        number: Number of the trial.
        trial: The trial.
        fitted: The object of the trial.
        T_world_object: Pose of the object (4, 4).
        frame: Number of executed actions.
        fail_reason: None while the trial continues, empty after a success, else the reason of the failure.
    """

    def __init__(self, world: World, number: int) -> None:
        self.world, self.number, self.trial = world, number, world.suite.trials[number]
        self._opened = world.factory.asset(self.trial.asset)
        self.fitted, scene = self._opened.sized(self.trial.variation.scale)
        self.T_world_object = self.trial.variation.place_at(self.fitted)
        self._scene = scene.place_at(self.T_world_object)
        start = np.append(self.trial.joints, self.trial.gripper)
        self._targets = Targets(world.suite.action_space, world.factory.solver, start)
        self._simulation = Simulation(
            self._scene, world.suite.fps, start, self.trial.setting, self.fitted.start_theta
        )
        self.reached: Trajectory = self._simulation.read_state()
        self.frame, self._held = 0, 0
        self.fail_reason: str | None = None

    @property
    def opening_share(self) -> float:
        """Return the signed travel of the object's joint divided by the planned travel."""
        return float((self.reached.thetas[0] - self.fitted.start_theta) / self.fitted.travel)

    @property
    def touched_obstacle(self) -> bool:
        """Return whether the robot has touched an obstacle, which is anything but object and table."""
        touched = self._simulation.run().touches.other_geoms
        return bool(self._scene.roles.obstacle[touched].any())

    @cached_property
    def _closed_keypoints(self) -> Array:
        return find_keypoints(self.fitted.asset)

    def locate_keypoints(self) -> Array:
        """Compute the true keypoints (5, 3) of the object at this frame, world frame, [m]."""
        joint = self.fitted.asset.joint
        return apply(
            self.T_world_object, move_keypoints(self._closed_keypoints, joint, self.reached.thetas[:1])[0]
        )

    @cached_property
    def _views(self) -> TrialViews:
        world = self.world
        return KINDS[world.visuals](
            world.factory, self._opened, self.fitted, self.trial.variation, world.carried
        )

    def observation(self, *, pixels: bool = True) -> dict[str, Any]:
        """Return the observation: "agent_pos" (J + 1,), float32, and optionally "pixels" by camera."""
        state = np.append(self.reached.joints[0], self.reached.gripper).astype(np.float32)
        return {"agent_pos": state, **({"pixels": self._pictures()} if pixels else {})}

    def _pictures(self) -> Images:
        """Render the image (H, W, 3) of every camera, reduced like those of a dataset."""
        sizes = {name: (camera.width, camera.height) for name, camera in self.world.suite.cameras.items()}
        return {
            name: image if image.shape[1::-1] == sizes[name] else resize(image, *sizes[name])
            for name, image in self._views.draw(self.reached).items()
        }

    def step(self, action: Array) -> None:
        """Execute an action; the trial ends if it has succeeded, failed or reached the time limit.

        Raises:
            ConfigError: The action has another shape.
        """
        suite = self.world.suite
        if action.shape != (suite.action_size,):
            raise ConfigError(
                "action", f"has shape {action.shape}", f"expected ({suite.action_size},), the gripper last"
            )
        target = self._targets.take(action)
        self.frame += 1
        if target is None:
            self.fail_reason = BAD_ACTION
            return
        self._simulation.follow(target)
        lost = self._simulation.check_divergence()
        if lost:
            self.fail_reason = lost.reason
            return
        self.reached = self._simulation.read_state()
        self._held = self._held + 1 if self.opening_share >= PassRule().target_share else 0
        if self._held >= self.world.held_frames or self.frame >= suite.max_frames:
            self.fail_reason = self._find_refusal()

    def _find_refusal(self) -> str:
        """Return the reason for which the pass rule rejects the trial; empty if it passes."""
        result = judge(self._simulation.run(), self.fitted, self._scene, self.trial.setting, PassRule())
        if isinstance(result, Rejection):
            return result.reason
        return "" if self._held >= self.world.held_frames else "target"
