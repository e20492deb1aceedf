"""Paths around obstacles reach their goal, are repeatable, and are refused where there are none."""

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.episodes.free_motion import find_free_path
from aomgen.episodes.ik import IkSolver
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import KinematicLimits, make_collision_test
from aomgen.simulation.scene import build_scene
from toy_drawer import SUPPORT

START, GOAL = np.array([-1.0, -1.0, -0.2]), np.array([1.0, 1.0, 0.2])
LIMITS = np.tile([-3.0, 3.0], (3, 1))


def outside_ball(joints: Array) -> bool:
    return bool(np.linalg.norm(joints) > 0.9)


def test_a_path_leads_around_an_obstacle() -> None:
    path = find_free_path(START, GOAL, LIMITS, outside_ball, 3)
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    assert all(map(outside_ball, path))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    # The straight line is 2.9 long and the shortest way around the ball 3.2.
    assert 3.1 < steps.sum() < 4.5
    # Smooth: no corner of more than 30 degrees.
    directions = np.diff(path, axis=0) / steps[:, None]
    assert np.sum(directions[1:] * directions[:-1], 1).min() > np.cos(np.deg2rad(30))


def test_equal_seeds_give_equal_paths() -> None:
    first = find_free_path(START, GOAL, LIMITS, outside_ball, 1)
    other = find_free_path(START, GOAL, LIMITS, outside_ball, 2)
    again = find_free_path(START, GOAL, LIMITS, outside_ball, 1)
    assert first is not None
    assert other is not None
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.abs(first - other).max() > 1e-6


@pytest.mark.parametrize("start", [START, np.zeros(3)])
def test_no_path_leads_through_a_wall_or_out_of_an_obstacle(start: Array) -> None:
    walled = find_free_path(
        start, GOAL, LIMITS, lambda joints: outside_ball(joints) and abs(joints[0]) > 0.2, 1
    )
    assert walled is None


def test_a_configuration_in_a_column_is_not_free(
    robot: RobotModel, fitted: FittedAsset, solver: IkSolver
) -> None:
    joints = np.array([2.11, -1.51, 2.26, -0.75, 0.53, 1.57])
    place = robot.ee_poses(joints[None])[0, :3, 3]
    column = OrientedBox(T_world_box=transform(np.eye(3), place), half_extents=np.full(3, 0.06))
    for boxes, free in (((), True), ((column,), False)):
        scene = build_scene(robot, fitted.asset, fitted.T_world_asset, SUPPORT, obstacles=boxes)
        assert make_collision_test(scene, 0.0, 0.0, KinematicLimits())(joints) is free
