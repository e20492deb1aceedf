"""An arm begins where it did in the demonstration, or nearby when the object stands there."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation
from aomgen.episodes.ik import IkSolver
from aomgen.episodes.planning import Planner, PlanParams, plan_episode
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from backwards import closing_of
from toy_drawer import SUPPORT


@pytest.mark.parametrize(("x", "moved"), [(0.0, False), (-0.2, True)])
def test_a_blocked_start_is_moved(
    robot: RobotModel, solver: IkSolver, fitted: FittedAsset, demo: Demonstration, x: float, moved: bool
) -> None:
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    variation = Variation(seed=0, index=0, x=x, y=0.0, yaw=0.0)
    plan = plan_episode(fitted, demo, variation, scene, solver, PlanParams())
    assert isinstance(plan, EpisodePlan)
    away = np.linalg.norm(robot.ee_poses(plan.joints[:1])[0, :3, 3] - demo.Ts_world_ee[0, :3, 3])
    assert (away > 0.05) == moved
    assert plan.metrics["penetration_mm"] <= 1.0


@pytest.mark.parametrize("open_m", [0.0, 0.15])
def test_the_arm_does_not_begin_in_a_drawer_that_stands_open(
    robot: RobotModel, solver: IkSolver, fitted: FittedAsset, demo: Demonstration, open_m: float
) -> None:
    """The hand begins 27 cm before the closed drawer, which is put 18 cm nearer."""
    closing = closing_of(demo)
    motion = replace(fitted, thetas=np.full(20, open_m))
    variation = Variation(seed=0, index=0, x=-0.18, y=0.0, yaw=0.0)
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT)
    start = Planner(motion, closing, variation, scene, solver, PlanParams()).start
    assert start is not None
    assert (not np.array_equal(start, closing.joints[0])) == (open_m > 0)
