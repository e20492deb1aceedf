"""The map of the arm's reach says no only where planning does."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VariationFrame
from aomgen.core.transforms import apply
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.reach_map import LINE_M, MAX_NODES, ReachMap, front_line, map_reach
from aomgen.episodes.variations import Ranges, draw, scale_fit
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from toy_drawer import SUPPORT

# From the robot's foot to far beyond its reach.
RANGES = Ranges(x_m=(-0.2, 0.6), y_m=(-0.3, 0.3), yaw_deg=(-90, 90))


@pytest.fixture(scope="module")
def found(solver: IkSolver, fitted: FittedAsset, demo: Demonstration) -> ReachMap:
    return map_reach(fitted, demo, RANGES, solver, PlanParams())


@pytest.mark.slow
def test_what_can_be_planned_is_on_the_map(
    robot: RobotModel, solver: IkSolver, fitted: FittedAsset, demo: Demonstration, found: ReachMap
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    drawn = [draw(0, 0, index, RANGES) for index in range(40)]
    results = [plan_episode(fitted, demo, item, scene, solver, PlanParams()) for item in drawn]
    planned = [item for item, result in zip(drawn, results, strict=True) if isinstance(result, EpisodePlan)]
    assert len(planned) > 5
    assert all(found.may_reach(item) for item in planned)
    beyond = [item for item in drawn if not found.may_reach(item)]
    assert len(beyond) > 5
    reasons = {result.reason for result in results if not isinstance(result, EpisodePlan)}
    assert "unreachable" in reasons


def test_the_map_covers_the_ranges_and_is_coarse(found: ReachMap, fitted: FittedAsset) -> None:
    assert found.reached.shape == (MAX_NODES,) * 3
    assert 0 < found.reached.mean() < 1
    assert (found.x[0], found.x[-1]) == RANGES.x_m
    middle = found.places_world[3, 3]
    here = Variation(seed=0, index=0, x=found.x[3], y=found.y[3], yaw=0.0)
    place = here.place_at(fitted) @ np.append(fitted.middle_asset, 1.0)
    np.testing.assert_allclose(middle, place[:2], atol=1e-9)
    # A draw that lies beside the map is left to planning.
    assert found.may_reach(replace(here, x=2.0))
    assert not found.may_reach(replace(here, x=0.6))


@pytest.mark.parametrize("frame", ["world", "object", "polygon"])
def test_a_line_begins_at_the_center_of_the_scaled_object(fitted: FittedAsset, frame: VariationFrame) -> None:
    there = Variation(seed=0, index=0, x=0.3, y=-0.1, yaw=0.7, frame=frame, scale=0.6)
    small = scale_fit(fitted, there.scale)
    center = apply(there.place_at(small), small.middle_asset)
    first, last = front_line(fitted, there, "rejected").points_world
    np.testing.assert_allclose(first, center[:2], atol=1e-12)
    assert np.linalg.norm(last - first) == pytest.approx(LINE_M)


def test_a_single_place_has_a_map(solver: IkSolver, fitted: FittedAsset, demo: Demonstration) -> None:
    ranges = Ranges(x_m=(0.0, 0.0), y_m=(0.0, 0.0), yaw_deg=(0.0, 0.0))
    found = map_reach(fitted, demo, ranges, solver, PlanParams())
    assert found.reached.tolist() == [[[True]]]
    assert found.may_reach(Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0))
