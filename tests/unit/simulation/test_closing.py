"""Plans that close an open object: honest ones pass, sabotaged ones are rejected for the right reason."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.plan import EpisodePlan, Rejection, VerifiedEpisode
from aomgen.core.transforms import transform
from aomgen.robots.robot import RobotModel
from aomgen.simulation.judge import PassRule, judge
from aomgen.simulation.replay import SimulatedRun, simulate
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.settings import corner_setting, draw_settings
from aomgen.simulation.verify import verify_plan
from toy_plans import FRAMES, SUPPORT, drawer_plan, microwave_plan

Episode = tuple[EpisodePlan, Scene]


def staged(robot: RobotModel, plan: EpisodePlan) -> Episode:
    return plan, build_scene(robot, plan.fitted.asset, plan.T_world_object, SUPPORT)


@pytest.fixture(scope="module")
def drawer(robot: RobotModel) -> Episode:
    return staged(robot, drawer_plan(robot, closing=True))


@pytest.fixture(scope="module")
def microwave(robot: RobotModel) -> Episode:
    return staged(robot, microwave_plan(robot, closing=True))


def reason(plan: EpisodePlan, scene: Scene) -> str:
    result = verify_plan(plan, scene)
    return result.reason if isinstance(result, Rejection) else "passed"


@pytest.mark.parametrize("index", range(4))
def test_what_is_honest_passes(drawer: Episode, microwave: Episode, index: int) -> None:
    for plan, scene in (drawer, microwave):
        variation = replace(plan.variation, index=2 * index + 1)
        result = verify_plan(replace(plan, variation=variation), scene)
        assert isinstance(result, VerifiedEpisode), result
        assert result.reached.thetas[0] == pytest.approx(plan.fitted.start_theta, abs=1e-3)
        finals = [outcome.final_theta for outcome in result.verdict.outcomes]
        assert max(finals) < 0.02 * plan.fitted.start_theta
        assert result.verdict.as_json()["start_theta"] == plan.fitted.start_theta


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_an_object_that_is_closed_already_is_rejected(drawer: Episode, share: float) -> None:
    plan, scene = drawer
    setting = draw_settings(plan.fitted.asset, 0, 0)[-1]
    start = share * plan.fitted.start_theta
    run = simulate(scene, plan.joints, plan.gripper, plan.fps, setting=setting, initial_theta=start)
    assert isinstance(run, SimulatedRun)
    result = judge(run, plan.fitted, scene, setting, PassRule())
    assert isinstance(result, Rejection)
    assert result.reason == "moved_early"


@pytest.mark.parametrize("way", [(0.2, 0, 0), (0.08, 0, 0), (0.06, 0.06, 0)])
def test_a_hand_that_ends_before_the_object_closes_too_little(
    drawer: Episode, way: tuple[float, ...]
) -> None:
    plan, scene = drawer
    moved = replace(plan, T_world_object=transform(np.eye(3), np.array(way)) @ plan.T_world_object)
    assert reason(moved, scene) == "target"


@pytest.mark.parametrize("height_m", [-0.08, 0.08])
def test_an_object_pushed_shut_beside_its_handle_does_not_count(drawer: Episode, height_m: float) -> None:
    plan, scene = drawer
    lifted = transform(np.eye(3), np.array([0.0, 0.0, height_m])) @ plan.T_world_object
    assert reason(replace(plan, T_world_object=lifted), scene) == "door_pushed"


@pytest.mark.parametrize("opened", [0.0, 0.3])
def test_an_object_pushed_shut_by_an_open_hand_does_not_count(drawer: Episode, opened: float) -> None:
    plan, scene = drawer
    assert reason(replace(plan, gripper=np.full(FRAMES, opened)), scene) == "door_pushed"


@pytest.mark.parametrize("frame", [8, 14, 18])
def test_a_grip_that_is_lost_on_the_way_does_not_count(microwave: Episode, frame: int) -> None:
    plan, scene = microwave
    gripper = np.where(np.arange(FRAMES) < frame, plan.gripper, 0.0)
    assert reason(replace(plan, gripper=gripper), scene) == "door_pushed"


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_way_that_is_too_short_does_not_count(drawer: Episode, share: float) -> None:
    plan, scene = drawer
    small = replace(plan, fitted=replace(plan.fitted, thetas=share * plan.fitted.thetas))
    assert reason(small, scene) == "target_too_small"


def test_a_spring_that_closes_the_object_is_noticed(drawer: Episode) -> None:
    plan, scene = drawer
    model = copy.copy(scene.model)
    model.jnt_stiffness[model.joint("object_joint").id] = 20.0
    assert reason(plan, replace(scene, model=model)) == "imposed"


def test_a_latch_holds_only_what_is_nearly_closed(drawer: Episode) -> None:
    setting = corner_setting(drawer[0].fitted.asset, True, True, True, True)
    assert setting.friction_at(0.15) == setting.frictionloss
    assert setting.friction_at(0.001) == setting.frictionloss + setting.latch
