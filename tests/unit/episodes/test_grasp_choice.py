"""Demonstrations of an object keep near to one grasp."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation
from aomgen.core.transforms import matrix_from_rotvec
from aomgen.episodes.grasp_choice import GraspChoice, choose_grasp
from aomgen.episodes.grasps import Grasp, difference, grasps
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.planning import Planner, PlanParams, plan_episode
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from toy_drawer import SUPPORT

HERE = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0)


def turned(deg: float, turn_ratio: float = 1.0) -> Grasp:
    return Grasp(
        name=f"{deg:g} {turn_ratio:g}",
        R_object_ee=matrix_from_rotvec(np.deg2rad([deg, 0.0, 0.0])),
        held_ee=np.zeros(3),
        turn_ratio=turn_ratio,
    )


def choose(working: Sequence[Sequence[Grasp]], failing: Sequence[Sequence[Grasp]] = ()) -> GraspChoice:
    """Choose from the working and failing grasps of each draw."""
    others = [*failing, *[()] * (len(working) - len(failing))]
    return choose_grasp(
        [
            [*((grasp, lambda: True) for grasp in good), *((grasp, lambda: False) for grasp in bad)]
            for good, bad in zip(working, others, strict=True)
        ]
    )


def working_grasps(planner: Planner) -> list[Grasp]:
    found = planner.list_candidates().values()
    return [candidates[0].motion.grasp for candidates in found if planner.works(candidates)]


def usual_name(chosen: GraspChoice) -> str:
    return "" if chosen.usual is None else chosen.usual.name


def test_the_usual_grasp_is_in_the_middle_of_what_is_needed() -> None:
    # Most draws could use 40, but the others would then differ by more than those from 20.
    chosen = choose([[turned(40), turned(20)], [turned(40)], [turned(20), turned(0)], [turned(0)], []])
    assert (usual_name(chosen), chosen.draws) == ("20 1", 5)
    assert chosen.mean_rad == pytest.approx(np.deg2rad(10.0))


def test_a_grasp_that_always_works_is_the_only_one_that_is_tested() -> None:
    tested = []

    def test(angle: float) -> bool:
        tested.append(angle)
        return angle == 20

    offered = [(turned(angle), partial(test, angle)) for angle in (0, 20, 40)]
    assert usual_name(choose_grasp([offered] * 5)) == "20 1"
    assert sorted(tested) == [0, 20, 20, 20, 20, 20]


def test_of_equals_the_nearest_to_the_demonstrated_is_chosen() -> None:
    assert usual_name(choose([[turned(0), turned(10)], [turned(0), turned(10)]])) == "0 1"
    assert choose([[], []]).usual is None
    assert choose([[], []], [[turned(0)], [turned(10)]]).usual is None


def test_hands_that_turn_less_with_a_door_differ() -> None:
    assert difference(turned(30), turned(10, turn_ratio=0.7)) == pytest.approx(np.deg2rad(20) + 0.3)


@settings(deadline=None)
@given(
    st.lists(st.lists(st.sampled_from(range(0, 180, 15)), unique=True), max_size=8),
    st.lists(st.booleans(), min_size=8, max_size=8),
)
def test_no_other_grasp_is_nearer_to_those_of_the_draws(
    working: list[list[float]], failing: list[bool]
) -> None:
    others = [
        [turned(angle) for angle in range(0, 180, 15) if angle not in angles] if fails else []
        for angles, fails in zip(working, failing, strict=False)
    ]
    chosen = choose([list(map(turned, angles)) for angles in working], others)
    served = [angles for angles in working if angles]
    means = {
        turned(usual).name: np.mean([min(abs(usual - angle) for angle in angles) for angles in served])
        for usual in chain.from_iterable(served)
    }
    assert (usual_name(chosen) in means) == bool(served)
    if served:
        assert np.rad2deg(chosen.mean_rad) == pytest.approx(min(means.values()))


def test_grasps_like_the_usual_one_are_tried_first(fitted: FittedAsset) -> None:
    tried = list(grasps(fitted, np.eye(3), [0.01], 1.0))
    usual = tried[7]
    again = list(grasps(fitted, np.eye(3), [0.01], 1.0, usual))
    assert sorted(grasp.name for grasp in again) == sorted(grasp.name for grasp in tried)
    ways = [difference(grasp, usual) for grasp in again]
    assert again[0].name == usual.name
    assert np.all(np.diff(ways) >= -1e-6)


def test_plans_use_the_usual_grasp_where_it_works(
    fitted: FittedAsset, demo: Demonstration, robot: RobotModel, solver: IkSolver
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    task = (fitted, demo, HERE, scene, solver, PlanParams())
    working = working_grasps(Planner(*task))
    assert len(working) > 1
    plain, usual = plan_episode(*task), plan_episode(*task, working[-1])
    assert isinstance(plain, EpisodePlan)
    assert isinstance(usual, EpisodePlan)
    assert plain.grasp.startswith(working[0].name)
    assert usual.grasp.startswith(working[-1].name)
    # Of one that the object does not offer the most similar is used.
    leaning = matrix_from_rotvec(0.01 * np.ones(3)) @ working[-1].R_object_ee
    similar = plan_episode(*task, replace(working[-1], name="another object's", R_object_ee=leaning))
    assert isinstance(similar, EpisodePlan)
    assert similar.grasp == usual.grasp


def test_where_the_usual_grasp_does_not_work_plans_come_near_to_it(
    fitted: FittedAsset, demo: Demonstration, robot: RobotModel, solver: IkSolver
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    task = (fitted, demo, HERE, scene, solver, PlanParams())
    working = working_grasps(Planner(*task))
    names = [grasp.name for grasp in working]
    shown = DemonstratedMotion(demo)
    offered = list(grasps(fitted, shown.hand_at_closed(fitted), [0.01], demo.ee_turn_ratio))
    shares = []
    for usual in [grasp for grasp in offered if grasp.name not in names and grasp.name != "turned"][::6]:
        plan = plan_episode(*task, usual)
        assert isinstance(plan, EpisodePlan)
        found = re.match(r"([\d.]+)% from (.*) to (.*); ", plan.grasp)
        if found:
            shares.append(float(found[1]))
            assert found[2] == usual.name
            assert found[3] in names
    assert shares
    assert set(shares) <= {12.5 * k for k in range(1, 8)}
