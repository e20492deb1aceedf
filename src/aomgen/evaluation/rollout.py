"""One trial in closed loop: actions in, physics, what the policy sees, and whether the object was moved as it shall be."""

import math
from functools import cached_property
from typing import Any, Final

import numpy as np

from aomgen.core.demonstration import Trajectory
from aomgen.core.plan import EpisodePlan, Rejection
from aomgen.core.values import Array
from aomgen.episodes.factory import EpisodeFactory
from aomgen.evaluation.actions import Targets, require_shape
from aomgen.evaluation.suite import Suite, fixed_cameras
from aomgen.evaluation.views import KINDS, Images, TrialViews, Visuals
from aomgen.io.images import resize
from aomgen.results import Results
from aomgen.simulation.judge import PassRule, judge
from aomgen.simulation.replay import Simulation

# The part has to stay where it shall be for this long, [s].
HELD_S: Final = 0.5
# Why a trial fails for which the pass rule has no word.
BAD_ACTION: Final = "bad_action"


class World:
    """A suite's trials and what they have in common, read once: robot, objects, cameras.

    Args:
        suite: The trials.
        results: Of the run that the suite belongs to.
        visuals: What pictures show.
    """

    def __init__(self, suite: Suite, results: Results, visuals: Visuals = "splat") -> None:
        self.suite, self.visuals = suite, visuals
        fixed = fixed_cameras(suite.cameras, results.robot)
        drawn = {name: camera.resize(*suite.drawn_size) for name, camera in fixed.items()}
        self.factory = EpisodeFactory(results, results.folders["episodes"], drawn)
        self.carried = tuple(name for name in suite.cameras if name not in fixed)
        # From the first to the last of them it takes that long.
        self.held_frames = 1 + math.ceil(HELD_S * suite.fps)

    def rollout(self, number: int) -> "Rollout":
        """A trial at its reset."""
        return Rollout(self, number)

    def plan(self, number: int) -> EpisodePlan:
        """The plan for a trial, which its certificate was given for."""
        trial = self.suite.trials[number]
        plan = self.factory.plan(self.factory.asset(trial.asset), trial.variation)
        if isinstance(plan, Rejection):
            raise ValueError(f"trial {number} has no plan: {plan.detail}")
        return plan


class Rollout:
    """One trial from its reset to its end.

    Attributes:
        number: Of the trial.
        trial: What is tried.
        fitted: The object.
        T_world_object: Its pose.
        frame: Actions taken.
        fail_reason: None as long as it goes on, empty when it has succeeded, else why not.
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
        """Way of the object's joint so far over the planned one, signed."""
        return float((self.reached.thetas[0] - self.fitted.start_theta) / self.fitted.travel)

    @cached_property
    def _views(self) -> TrialViews:
        world = self.world
        return KINDS[world.visuals](
            world.factory, self._opened, self.fitted, self.trial.variation, world.carried
        )

    def observation(self, *, pixels: bool = True) -> dict[str, Any]:
        """What the policy sees: "agent_pos" (J + 1,), float32, and "pixels" by camera where they are wanted."""
        state = np.append(self.reached.joints[0], self.reached.gripper).astype(np.float32)
        return {"agent_pos": state, **({"pixels": self._pictures()} if pixels else {})}

    def _pictures(self) -> Images:
        """Image (H, W, 3) of every camera, made smaller as a dataset's are."""
        sizes = {name: (camera.width, camera.height) for name, camera in self.world.suite.cameras.items()}
        return {
            name: image if image.shape[1::-1] == sizes[name] else resize(image, *sizes[name])
            for name, image in self._views.draw(self.reached).items()
        }

    def step(self, action: Array) -> None:
        """Take an action, and end the trial where it succeeds, fails or has lasted too long.

        Raises:
            ConfigError: The action has another shape.
        """
        suite = self.world.suite
        require_shape(action, suite.action_size)
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
        """Why the certificate would be refused; empty where it would be given."""
        result = judge(self._simulation.run(), self.fitted, self._scene, self.trial.setting, PassRule())
        if isinstance(result, Rejection):
            return result.reason
        return "" if self._held >= self.world.held_frames else "target"
