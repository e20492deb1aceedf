"""Cameras and states as users write them: what is missing or wrong is named in words."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from aomgen.core.alignment import FixedCamera
from aomgen.core.camera import Camera
from aomgen.errors import ConfigError, UnknownNameError
from aomgen.pipeline import rendering as run_cameras
from aomgen.pipeline.rendering import parse_camera, parse_state
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel, TwinState

WHERE = Path("camera.json")
CAMERA = {
    "T_world_cam": np.eye(4).tolist(), "fx": 300, "fy": 300.0, "cx": 160, "cy": 120, "width": 320, "height": 240
}  # fmt: skip
SCALED = (2 * np.eye(4)).tolist()
REST = TwinState(joints=np.zeros(2), gripper=0.5, theta=0.1, T_world_object=np.eye(4))


def test_a_camera_is_read() -> None:
    camera = parse_camera(CAMERA, WHERE)
    assert (camera.fx, camera.width, camera.height) == (300.0, 320, 240)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({}, "lacks T_world_cam, fx, fy, cx, cy, width, height"),
        (
            {name: value for name, value in CAMERA.items() if name != "fx"},
            "lacks fx; expected T_world_cam, fx",
        ),
        ([], "is not a JSON object"),
        (CAMERA | {"fx": "wide"}, "'fx' is not a number"),
        (CAMERA | {"fx": None}, "'fx' is not a number"),
        (CAMERA | {"fy": 0}, "'fy' is 0 px"),
        (CAMERA | {"width": -3}, "'width' is -3 px"),
        (CAMERA | {"height": 1_000_000}, "'height' is 1e+06 px"),
        (CAMERA | {"T_world_cam": "above"}, "'T_world_cam' is not a matrix of numbers"),
        (CAMERA | {"T_world_cam": [[1, 0], [0]]}, "'T_world_cam' is not a matrix of numbers"),
        (CAMERA | {"T_world_cam": [1, 2, 3]}, "'T_world_cam' has shape (3,)"),
        (CAMERA | {"T_world_cam": SCALED}, "'T_world_cam' is not a rotation"),
    ],
)
def test_what_is_no_camera_is_told_in_words(data: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_camera(data, WHERE)
    assert words in str(caught.value)


def state_of(data: Any) -> TwinState:
    twin = cast(TwinModel, SimpleNamespace(scan_state=REST))
    robot = cast(RobotModel, SimpleNamespace(joint_names=("shoulder", "elbow")))
    return parse_state(data, twin, robot, Path("state.json"))


def test_a_state_fills_up_from_the_scan() -> None:
    state = state_of({"joints": {"elbow": 1}, "theta": 0.7})
    assert state.joints.tolist() == [0, 1]
    assert (state.gripper, state.theta) == (0.5, 0.7)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([0.3], "is not a JSON object"),
        ({"angle": 1}, "unknown key 'angle'; known: joints, gripper, theta, T_world_object"),
        ({"joints": [0, 0]}, "known joints: shoulder, elbow"),
        ({"joints": {"knee": 1}}, "unknown joint 'knee'; known: shoulder, elbow"),
        ({"joints": {"elbow": "bent"}}, "'elbow' is not a number"),
        ({"theta": [1]}, "'theta' is not a number"),
        ({"T_world_object": SCALED}, "'T_world_object' is not a rotation"),
    ],
)
def test_what_is_no_state_is_told_in_words(data: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        state_of(data)
    assert words in str(caught.value)


VIDEO = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
EPISODES = VIDEO.resize(320, 240)
SCAN = replace(VIDEO, fx=500)


@pytest.fixture
def results(tmp_path: Path) -> Any:
    (tmp_path / "07_replacement").mkdir()
    return SimpleNamespace(
        folders={"replacement": tmp_path / "07_replacement"},
        scan_cameras={"0001.jpg": SCAN, "0000.jpg": SCAN},
        episode_scene=SimpleNamespace(cameras={"front": EPISODES, "side": EPISODES}),
        alignment=SimpleNamespace(cameras={"front": FixedCamera(camera=VIDEO, clock=None)}),
    )


def test_cameras_of_video_episodes_and_scan_have_names(results: Any) -> None:
    assert run_cameras.find_camera(results, "front") is VIDEO
    assert run_cameras.find_camera(results, "side") is EPISODES
    assert run_cameras.find_camera(results, "0001.jpg") is SCAN


def test_an_unknown_camera_lists_the_known_ones(results: Any) -> None:
    with pytest.raises(UnknownNameError, match=r"'back' .*known: front, side, 0001\.jpg, 0000\.jpg"):
        run_cameras.find_camera(results, "back")


def test_before_the_replacement_there_are_the_recording_s_cameras(results: Any) -> None:
    results.folders["replacement"].rmdir()
    with pytest.raises(UnknownNameError, match=r"known: front, 0001\.jpg"):
        run_cameras.find_camera(results, "side")
