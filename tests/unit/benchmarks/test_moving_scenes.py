"""Scenes with moving parts touch the share of the image that they promise."""

import itertools

import numpy as np
import pytest

from aomgen.core.gaussians import concatenate
from aomgen.splatting.rasterizer import render
from benchmarks.moving_scenes import arm_scene, moved, objects_scene, touched_share, touched_tiles
from benchmarks.scenes import table_camera, table_top


def test_objects_move_and_the_rest_stands():
    camera = table_camera(320, 240)
    scene = objects_scene(20_000, camera, 0.25)
    assert touched_share(scene, 6) == pytest.approx(0.25, abs=0.03)
    assert len(scene.static) + len(scene.moving) == 20_000
    rest = concatenate([scene.static, scene.moving])
    assert np.abs(render(rest, camera).rgb - render(table_top(20_000, 3), camera).rgb).max() < 1e-2
    drawn = [render(concatenate([scene.static, moved(scene, frame)]), camera).rgb for frame in (0, 1)]
    changes = np.abs(drawn[0] - drawn[1]).max(2)
    assert changes.max() > 1e-2
    assert np.median(changes) == 0


def test_more_share_moves_more_objects():
    camera = table_camera(160, 120)
    few, many = (len(objects_scene(2000, camera, share).moving) for share in (0.1, 0.3))
    assert 0 < few < many


def test_neighbouring_frames_differ():
    scene = arm_scene(100, 200, table_camera(64, 64))
    poses = [scene.Ts_world_part(frame) for frame in range(25)]
    changes = [np.abs(a - b).max() for a, b in itertools.pairwise(poses)]
    assert min(changes) > 1e-4


def test_the_arm_covers_a_quarter_of_a_small_image():
    scene = arm_scene(10, 30_000, table_camera(256, 256))
    assert touched_share(scene, 1) == pytest.approx(0.28, abs=0.05)


def test_parts_turn_about_the_pivot():
    scene = arm_scene(10, 20, table_camera(64, 64))
    for T in scene.Ts_world_part(3):
        np.testing.assert_allclose(T[:3, :3] @ scene.pivot + T[:3, 3], scene.pivot, atol=1e-12)
    angles = np.degrees(np.arccos(scene.Ts_world_part(5)[:, 0, 0]))
    assert np.all(angles <= scene.swings_deg + 1e-6)
    assert angles.max() > 7


def test_tiles_are_touched_where_something_is_seen():
    camera = table_camera(70, 50)
    gaussians = table_top(500, 0)
    assert touched_tiles(gaussians, camera).shape == (4, 5)
    assert touched_tiles(gaussians, camera).mean() > 0.9
    assert not touched_tiles(gaussians.select(np.zeros(500, bool)), camera).any()
    assert touched_tiles(gaussians.select(np.array([400])), camera).mean() < 0.9
