"""Boxes that stand in a scene are found again from its Gaussians; specks, the table's noise and the robot are not."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox, upright_axes
from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.transforms import quat_from_matrix, transform
from aomgen.replacement.obstacles import _parts, _standing, find_obstacles, free_rectangle
from aomgen.robots.robot import RobotConfiguration, RobotModel, longest_reach
from aomgen.twin.support import Support

TABLE = 0.05
# Where the removed object stood, in front of the robot.
SUPPORT = Support(
    T_world_plane=transform(np.eye(3), [0.7, 0.0, TABLE]),
    low=np.array([-0.15, -0.15]),
    high=np.array([0.15, 0.15]),
    reach_low=np.array([-0.2, -0.2]),
    reach_high=np.array([0.2, 0.2]),
    top=0.3,
)


def standing(x: float, y: float, yaw: float, size: tuple[float, float, float]) -> OrientedBox:
    half = np.array(size) / 2
    T = transform(upright_axes(yaw), [x, y, TABLE + half[2]])
    return OrientedBox(T_world_box=T, half_extents=half)


CARTON, BOOK = standing(0.35, 0.55, 0.3, (0.2, 0.14, 0.16)), standing(0.6, -0.55, -0.5, (0.2, 0.14, 0.03))
WALL = standing(1.15, 0.1, 0.1, (0.05, 1.2, 2.0))


def sheet(box: OrientedBox, rng: np.random.Generator) -> Gaussians:
    """Noisy discs of 6 mm on the four sides and the top of a box, one every 5 mm; the bottom is not seen."""
    means, turns = [], []
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        others = [k for k in range(3) if k != axis]
        half = box.half_extents[others]
        local = np.zeros((int(4 * half.prod() / 0.005**2), 3))
        local[:, axis] = side * box.half_extents[axis]
        local[:, others] = rng.uniform(-half, half, (len(local), 2))
        face = np.eye(3)[:, [*others, axis]]
        face[:, 2] *= np.linalg.det(face)
        means.append(local @ box.T_world_box[:3, :3].T + box.T_world_box[:3, 3])
        turns.append(np.repeat((box.T_world_box[:3, :3] @ face)[None], len(local), 0))
    points = np.concatenate(means)
    return discs(points + rng.normal(0, 0.002, points.shape), np.concatenate(turns), 0.006, 0.8)


def discs(means: np.ndarray, turns: np.ndarray, radius: float, opacities: np.ndarray | float) -> Gaussians:
    count = len(means)
    return gaussians_of(
        means=means,
        quats=quat_from_matrix(np.broadcast_to(turns, (count, 3, 3))),
        scales=np.full((count, 3), [radius, radius, 0.001]),
        opacities=np.broadcast_to(opacities, count),
        sh=np.zeros((count, 1, 3)),
    )


def clutter(rng: np.random.Generator) -> Gaussians:
    """A rough table, 500 specks above it, and a sky."""
    table = rng.uniform([-0.2, -0.8, TABLE], [1.3, 0.8, TABLE], (6000, 3))
    table[:, 2] += np.abs(rng.normal(0, 0.006, 6000))
    specks = rng.uniform([-0.2, -0.8, TABLE], [1.3, 0.8, 1.0], (500, 3))
    sky = discs(np.array([[0.5, 0.0, 0.6]]), np.eye(3), 1e4, 0.5)
    return concatenate([
        discs(table, np.eye(3), 0.01, 0.8),
        discs(specks, np.eye(3), 0.01, rng.uniform(0.02, 0.6, 500)),
        sky,
    ])  # fmt: skip


@pytest.fixture(scope="module")
def standing_robot(robot: RobotModel) -> RobotConfiguration:
    return RobotConfiguration(robot=robot, joints=np.array([0.5, -1.5, 2.2, -0.7, 0.5, 1.5]), gripper=0.0)


def found_in(parts: list[Gaussians], robot: RobotConfiguration) -> tuple[OrientedBox, ...]:
    return find_obstacles(concatenate(parts), SUPPORT, longest_reach(robot.robot), robot)


def farthest_corner(box: OrientedBox, true: OrientedBox) -> float:
    """Largest distance of a corner of one box from the nearest of the other, [m]."""
    between = np.linalg.norm(box.corners()[:, None] - true.corners(), axis=-1)
    return float(max(between.min(0).max(), between.min(1).max()))


@pytest.mark.parametrize("seed", range(4))
def test_boxes_are_found_again(standing_robot: RobotConfiguration, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = found_in([sheet(CARTON, rng), sheet(BOOK, rng), clutter(rng)], standing_robot)
    assert len(found) == 2
    for true in (CARTON, BOOK):
        assert min(farthest_corner(box, true) for box in found) < 0.015


def test_thin_parts_of_obstacles_are_kept() -> None:
    """The foot of a lamp and its pole of 4 x 4 cm, which covers four cells."""
    foot = np.mgrid[0.001:0.2:0.004, 0.001:0.2:0.004, 0.016:0.03:0.004].reshape(3, -1).T
    pole = np.mgrid[0.081:0.12:0.004, 0.081:0.12:0.004, 0.03:0.5:0.004].reshape(3, -1).T
    (lamp,) = _standing(np.concatenate([foot, pole]))
    heights = sorted(part[:, 2].max() for part in _parts(lamp))
    assert heights[-1] == pytest.approx(0.5, abs=0.01)
    assert heights[-2] < 0.05


def test_a_wall_is_cut_where_the_reach_ends(standing_robot: RobotConfiguration) -> None:
    rng = np.random.default_rng(0)
    (found,) = found_in([sheet(WALL, rng), clutter(rng)], standing_robot)
    local = np.abs(WALL.coordinates(found.corners())[:, 0])
    np.testing.assert_allclose(local, 0.025, atol=0.015)
    top = found.corners()[:, 2].max()
    assert 0.7 < top < 0.16 + longest_reach(standing_robot.robot).reach_m + 0.3


def test_things_side_by_side_are_told_apart(standing_robot: RobotConfiguration) -> None:
    rng, beside = np.random.default_rng(0), standing(0.35, 0.4, 0.3, (0.2, 0.14, 0.03))
    found = found_in([sheet(CARTON, rng), sheet(beside, rng), clutter(rng)], standing_robot)
    tops = sorted(box.corners()[:, 2].max() - TABLE for box in found)
    assert len(tops) == 2
    np.testing.assert_allclose(tops, [0.03, 0.16], atol=0.015)


def test_specks_table_robot_and_the_object_s_rest_are_no_obstacles(
    standing_robot: RobotConfiguration,
) -> None:
    rng = np.random.default_rng(1)
    own = discs(standing_robot.surface_world(20_000, rng), np.eye(3), 0.01, 0.9)
    rest = sheet(standing(0.7, 0.0, 0.0, (0.2, 0.2, 0.2)), rng)
    hanging = sheet(
        OrientedBox(T_world_box=transform(np.eye(3), [0.4, 0.5, 0.6]), half_extents=np.full(3, 0.05)), rng
    )
    assert found_in([own, rest, hanging, clutter(rng)], standing_robot) == ()
    far = sheet(standing(3.0, 0.0, 0.0, (0.2, 0.2, 0.2)), rng)
    assert found_in([far], standing_robot) == ()


def test_no_box_holds_a_part_of_the_robot(standing_robot: RobotConfiguration) -> None:
    rng = np.random.default_rng(2)
    surface = standing_robot.surface_world(20_000, rng)
    foot = float(surface[:, 2].min())
    # What the robot stands on, scanned a little too high.
    half = np.array([0.2, 0.2, 0.03])
    pedestal = OrientedBox(
        T_world_box=transform(upright_axes(0.2), [0.0, 0.0, foot + 0.008 - half[2]]), half_extents=half
    )
    support = replace(SUPPORT, T_world_plane=transform(np.eye(3), [0.7, 0.0, foot + 0.008 - 0.06]))
    found = find_obstacles(sheet(pedestal, rng), support, longest_reach(standing_robot.robot), standing_robot)
    assert found
    for box in found:
        assert not (np.abs(box.coordinates(surface)) < box.half_extents).all(1).any()


def table(spacing=0.01):
    x, y = np.meshgrid(np.arange(-0.3, 0.9, spacing), np.arange(-0.5, 0.7, spacing))
    return np.stack([x.ravel(), y.ravel()], 1)


def test_growth_stops_at_the_table_edges():
    low, high = free_rectangle(table(), [0.1, 0.0], [0.4, 0.3])
    assert np.allclose(low, [-0.3, -0.5], atol=0.03)
    assert np.allclose(high, [0.9, 0.7], atol=0.03)


def test_growth_stops_at_another_object():
    xy = table()
    hidden = (xy[:, 0] > 0.6) & (xy[:, 0] < 0.75) & (xy[:, 1] > 0.0) & (xy[:, 1] < 0.2)
    low, high = free_rectangle(xy[~hidden], [0.1, 0.0], [0.4, 0.2])
    box = (xy[hidden] > low) & (xy[hidden] < high)
    assert not np.all(box, axis=1).any()


def test_the_hidden_surface_under_the_object_is_free():
    xy = table()
    under = np.all((xy > [0.1, 0.0]) & (xy < [0.4, 0.3]), axis=1)
    low, high = free_rectangle(xy[~under], [0.1, 0.0], [0.4, 0.3])
    assert np.all(high - low > 1.0)


def test_without_any_surface_nothing_grows():
    low, high = free_rectangle(np.zeros((0, 2)), [0.1, 0.0], [0.4, 0.3])
    assert np.allclose(high - low, [0.3, 0.3], atol=0.05)
