"""Objects stand on the free part of a table, which ends at its edges and at what stands on it.

A second camera looks on from another side.
"""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.errors import ReconstructionError
from aomgen.replacement.stage import choose_viewpoint, free_rectangle


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


def scan_cameras(toy_scene) -> dict[str, Camera]:
    target = np.array([0.6, -0.1, 0.1])
    eyes = {
        "near_first": (-0.45, -0.85, 0.75),
        "opposite": (0.2, 0.9, 0.7),
        "below_table": (0.2, 0.9, -0.6),
        "behind_wall": (2.2, 0.3, 0.6),
        "looks_away": (0.1, 0.9, 0.7),
    }
    cameras = {name: toy_scene.camera.moved(look_at(eye, target)) for name, eye in eyes.items()}
    cameras["looks_away"] = toy_scene.camera.moved(look_at(eyes["looks_away"], (0.1, 3.0, 0.7)))
    return cameras


def test_the_second_camera_looks_from_another_side_and_sees_the_object(toy_scene):
    points = [np.array([[0.38, 0.1, 0.1], [0.42, 0.05, 0.2], [0.6, 0.0, 0.32]])]
    found = choose_viewpoint(
        scan_cameras(toy_scene),
        toy_scene.camera,
        toy_scene.twin,
        toy_scene.robot,
        [toy_scene.twin.scan_state],
        points,
    )
    np.testing.assert_allclose(found.center, scan_cameras(toy_scene)["opposite"].center)
    assert found.width == toy_scene.camera.width


def test_no_usable_view_is_refused(toy_scene):
    arguments = (
        toy_scene.camera,
        toy_scene.twin,
        toy_scene.robot,
        [toy_scene.twin.scan_state],
        [np.zeros((1, 3))],
    )
    with pytest.raises(ReconstructionError, match="no scan camera is registered"):
        choose_viewpoint({}, *arguments)
    with pytest.raises(ReconstructionError, match="sees the action"):
        choose_viewpoint({"looks_away": scan_cameras(toy_scene)["looks_away"]}, *arguments)
