"""Few grasps serve most draws, and plans try them first."""

from hypothesis import given
from hypothesis import strategies as st

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation
from aomgen.episodes.grasp_choice import choose_grasps
from aomgen.episodes.grasp_plan import PlanParams
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.planning import open_task, plan_episode, working_grasps
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from benchmarks.toy_drawer import SUPPORT

HERE = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)


def test_the_grasp_that_serves_most_draws_comes_first_then_that_for_most_of_the_rest() -> None:
    chosen = choose_grasps([["a", "b"], ["b"], ["c", "b"], ["a", "c"], ["c"], []])
    assert chosen.names == ("b", "c")
    assert chosen.served == (3, 2)
    assert chosen.draws == 6


def test_of_equals_the_nearest_to_the_demonstrated_is_chosen() -> None:
    assert choose_grasps([["near", "far"], ["near", "far"]]).names == ("near",)
    assert choose_grasps([]).names == ()


@given(st.lists(st.lists(st.sampled_from("abcdef"), unique=True), max_size=12))
def test_every_draw_that_can_be_served_is(working: list[list[str]]) -> None:
    chosen = choose_grasps(working)
    assert all(set(names) & set(chosen.names) for names in working if names)
    assert sum(chosen.served) == sum(bool(names) for names in working)
    assert list(chosen.served) == sorted(chosen.served, reverse=True)


def test_plans_use_the_preferred_grasp_where_it_works(
    fitted: FittedAsset, demo: Demonstration, robot: RobotModel, solver: IkSolver
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    task = (fitted, demo, HERE, scene, solver, PlanParams())
    working = working_grasps(open_task(*task))
    assert len(working) > 1
    plain, preferring = plan_episode(*task), plan_episode(*task, working[-1:])
    assert isinstance(plain, EpisodePlan)
    assert isinstance(preferring, EpisodePlan)
    assert plain.grasp.startswith(working[0])
    assert preferring.grasp.startswith(working[-1])
    # One that does not work is passed over.
    passed_over = plan_episode(*task, ["no such grasp"])
    assert isinstance(passed_over, EpisodePlan)
    assert passed_over.grasp == plain.grasp
