"""A second camera looks on from another side."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.errors import ReconstructionError
from aomgen.replacement.viewpoint import choose_viewpoint


def scan_cameras(toy_scene) -> dict[str, Camera]:
    target = np.array([0.6, -0.1, 0.1])
    eyes = {
        "near_first": (-0.45, -0.85, 0.75),
        "opposite": (0.2, 0.9, 0.7),
        "below_table": (0.2, 0.9, -0.6),
        "behind_wall": (2.2, 0.3, 0.6),
        "looks_away": (0.1, 0.9, 0.7),
    }
    cameras = {name: toy_scene.camera.move(look_at(eye, target)) for name, eye in eyes.items()}
    cameras["looks_away"] = toy_scene.camera.move(look_at(eyes["looks_away"], (0.1, 3.0, 0.7)))
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
    with pytest.raises(ReconstructionError, match="the action is not visible"):
        choose_viewpoint({"looks_away": scan_cameras(toy_scene)["looks_away"]}, *arguments)
