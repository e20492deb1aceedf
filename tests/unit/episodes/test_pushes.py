"""Pushed demonstrations leave their plan on the way to the object, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.pushes import CALM_S, push_joints
from aomgen.episodes.retarget import CONTACT
from aomgen.episodes.variations import Ranges
from aomgen.errors import ConfigError
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan
from toy_drawer import SUPPORT

PUSHED = Variation(seed=3, index=5, x=0.0, y=0.0, yaw=0.0, push_m=0.02)


@pytest.fixture(scope="module")
def scene(robot: RobotModel, fitted: FittedAsset) -> Scene:
    return build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)


@pytest.fixture(scope="module")
def plan(fitted: FittedAsset, demo: Demonstration, scene: Scene, solver: IkSolver) -> EpisodePlan:
    made = plan_episode(fitted, demo, PUSHED, scene, solver, PlanParams())
    assert isinstance(made, EpisodePlan), made
    return made


def ways_mm(robot: RobotModel, plan: EpisodePlan, joints: np.ndarray) -> np.ndarray:
    return 1000 * np.linalg.norm(robot.ee_poses(joints)[:, :3, 3] - plan.Ts_world_ee[:, :3, 3], axis=1)


def test_the_hand_is_pushed_by_no_more_than_asked_and_comes_back_before_it_holds(
    robot: RobotModel, solver: IkSolver, plan: EpisodePlan
) -> None:
    ways = ways_mm(robot, plan, push_joints(plan, solver))
    first = int(np.argmax(plan.phases == CONTACT))
    assert 3.0 < ways.max() < 21.0
    assert ways[0] < 1e-6
    assert ways[first - round(CALM_S * plan.fps) :].max() < 1e-6
    # Smooth: from one frame to the next by a third of the largest way at most.
    assert np.abs(np.diff(ways)).max() < 7.0
    np.testing.assert_array_equal(push_joints(plan, solver), push_joints(plan, solver))


def test_without_pushes_the_plan_is_told(solver: IkSolver, plan: EpisodePlan) -> None:
    calm = replace(plan, variation=replace(PUSHED, push_m=0.0))
    np.testing.assert_array_equal(push_joints(calm, solver), plan.joints)


def test_a_pushed_demonstration_is_certified_and_its_actions_are_the_plans(
    robot: RobotModel, scene: Scene, solver: IkSolver, plan: EpisodePlan
) -> None:
    commanded = push_joints(plan, solver)
    made = verify_plan(plan, scene, commanded=commanded)
    assert isinstance(made, VerifiedEpisode), made
    # The arm went where it was told, off the plan that the actions are taken from.
    assert np.abs(made.reached.joints - commanded).max() < 0.02
    assert ways_mm(robot, plan, made.reached.joints).max() > 3.0
    np.testing.assert_array_equal(made.plan.joints, plan.joints)


def test_pushes_beyond_what_planning_keeps_clear_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"push_m: is \(0.0, 0.5\); expected 0 to 0.02"):
        Ranges(push_m=(0.0, 0.5))
