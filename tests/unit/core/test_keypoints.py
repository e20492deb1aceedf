"""Keypoints of made assets: they lie on handle and axis, move with the part, and follow a mirror."""

from collections.abc import Callable

import numpy as np
import pytest

from aomgen.assets.choice import MAKERS, OTHER_MAKERS
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.keypoints import KEYPOINTS, find_keypoints, move_keypoints, project_keypoints
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity
from aomgen.replacement.correspondence import mirror_asset

Made = Callable[[str, int], ArticulatedAsset]
CATEGORIES = [*MAKERS, *OTHER_MAKERS]


def axis_distances(asset: ArticulatedAsset, points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(points - asset.joint.origin, asset.joint.axis), axis=1)


@pytest.mark.parametrize("category", CATEGORIES)
@pytest.mark.parametrize("seed", [1, 4])
def test_points_lie_on_handle_and_axis(made: Made, category: str, seed: int) -> None:
    asset = made(category, seed)
    points = find_keypoints(asset)
    assert points.shape == (len(KEYPOINTS), 3)
    bar = asset.handle_bar
    assert bar is not None
    assert all(bar.distance(point) < 1e-6 for point in points[:3])
    ends, axis = points[2] - points[1], points[4] - points[3]
    along = np.abs(bar.T_asset_box[:3, :3].T @ asset.handle_axis) @ bar.half_extents
    assert np.linalg.norm(ends) == pytest.approx(2 * along)
    assert np.linalg.norm(np.cross(axis, asset.joint.axis)) == pytest.approx(0, abs=1e-9)
    low, high = asset.moving.bounds
    assert ((points[3:] > low - 0.05) & (points[3:] < high + 0.05)).all()
    if asset.joint.type == "revolute":
        assert axis_distances(asset, points[3:]) == pytest.approx([0, 0], abs=1e-9)
    assert points[1, 2] <= points[2, 2] + 1e-4
    assert points[3, 2] <= points[4, 2] + 1e-4


@pytest.mark.parametrize("category", CATEGORIES)
def test_points_move_with_the_part_and_the_axis_stands(made: Made, category: str) -> None:
    asset = made(category, 2)
    closed = find_keypoints(asset)
    thetas = np.linspace(0, asset.joint.upper, 4)
    points = move_keypoints(closed, asset.joint, thetas)
    assert points[0] == pytest.approx(closed)
    assert np.ptp(points[:, 3:], axis=0) == pytest.approx(0)
    apart = np.linalg.norm(points[:, :3, None] - points[:, None, :3], axis=-1)
    assert np.ptp(apart, axis=0) == pytest.approx(0, abs=1e-12)
    if asset.joint.type == "revolute":
        distances = [axis_distances(asset, frame) for frame in points]
        assert np.ptp(distances, axis=0) == pytest.approx(0, abs=1e-12)
    else:
        assert (points[:, :3] - closed[:3]) @ asset.joint.axis == pytest.approx(np.tile(thetas, (3, 1)).T)


@pytest.mark.parametrize("category", CATEGORIES)
def test_points_follow_a_similarity_about_the_vertical(made: Made, category: str) -> None:
    asset = made(category, 3)
    S = similarity(0.7, matrix_from_rotvec([0, 0, np.pi]), [0.3, -0.2, 0.1])
    moved = find_keypoints(asset.transform(S))
    wanted = apply(S, find_keypoints(asset))
    # Half a turn about the vertical exchanges ends that only x and y order.
    level = [k for k in (1, 3) if abs(wanted[k, 2] - wanted[k + 1, 2]) < 1e-4]
    for k in level:
        if np.linalg.norm(moved[k] - wanted[k]) > 1e-6:
            wanted[[k, k + 1]] = wanted[[k + 1, k]]
    assert moved == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_mirrored_door_has_mirrored_points(made: Made, seed: int) -> None:
    asset = made("microwave", seed)
    mirrored = find_keypoints(mirror_asset(asset))
    assert mirrored == pytest.approx(find_keypoints(asset) * [-1, 1, 1], abs=1e-9)


def test_points_behind_a_camera_are_in_no_image() -> None:
    camera = Camera(
        fx=100, fy=100, cx=50, cy=50, width=100, height=100, T_world_cam=look_at((0, 0, 0), (1, 0, 0))
    )
    pixels, depths = project_keypoints(camera, np.array([[2.0, 0, 0], [-1.0, 0, 0]]))
    assert pixels[0] == pytest.approx([50, 50])
    assert pixels[1] == pytest.approx([-1, -1])
    assert depths == pytest.approx([2, -1])
