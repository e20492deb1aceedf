"""One value for a robot over time: samples, interpolation, poses; derived values keep what they add."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import pytest

from aomgen.core.demonstration import SceneTrajectory, Trajectory
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel

PATH = Trajectory(
    times_s=[0.0, 0.5, 1.0],
    joints=[[0.0, 1.0], [1.0, 1.0], [1.0, 3.0]],
    gripper=[0.0, 1.0, 1.0],
    thetas=[0.0, 0.0, 0.2],
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Noted(Trajectory):
    poses: Annotated[Array, "T 4 4"]
    note: str


def test_values_between_samples_are_linear_and_beyond_them_constant() -> None:
    found = PATH.at([-1.0, 0.25, 0.75, 9.0])
    np.testing.assert_allclose(found.joints, [[0, 1], [0.5, 1], [1, 2], [1, 3]])
    np.testing.assert_allclose(found.gripper, [0, 0.5, 1, 1])
    np.testing.assert_allclose(found.thetas, [0, 0, 0.1, 0.2])
    np.testing.assert_array_equal(PATH.at(PATH.times_s).joints, PATH.joints)


def test_rows_of_a_derived_value_are_taken_of_all_that_changes_over_time() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1)) * np.arange(3)[:, None, None]
    names = ("times_s", "joints", "gripper", "thetas")
    noted = Noted(**{name: getattr(PATH, name) for name in names}, poses=poses, note="x")
    for rows in (slice(1, None), np.array([1, 2]), np.array([False, True, True])):
        part = noted[rows]
        assert isinstance(part, Noted)
        assert (len(part), part.note) == (2, "x")
        np.testing.assert_array_equal(part.times_s, [0.5, 1.0])
        np.testing.assert_array_equal(part.poses, poses[1:])


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Trajectory\.gripper: has shape \(2,\)"):
        replace(PATH, gripper=[0.0, 1.0])
    with pytest.raises(ValueError, match="T_world_object"):
        SceneTrajectory(times_s=[0], joints=[[0]], gripper=[0], thetas=[0], T_world_object=np.eye(3))


def test_poses_are_the_robots(robot: RobotModel) -> None:
    joints = np.random.default_rng(0).uniform(-1, 1, (3, 6))
    np.testing.assert_array_equal(replace(PATH, joints=joints).ee_poses(robot), robot.ee_poses(joints))
