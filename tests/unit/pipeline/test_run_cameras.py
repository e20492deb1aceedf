"""Cameras of a run by their names."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.core.camera import Camera
from aomgen.core.fixed_camera import FixedCamera
from aomgen.core.project import Project
from aomgen.errors import ConfigError
from aomgen.pipeline import rendering as run_cameras

VIDEO = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
EPISODES = VIDEO.resized(320, 240)
SCAN = replace(VIDEO, fx=500)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    (tmp_path / "07_replacement").mkdir()
    results = SimpleNamespace(
        folders={"replacement": tmp_path / "07_replacement"},
        scan_cameras={"0001.jpg": SCAN, "0000.jpg": SCAN},
        episode_scene=SimpleNamespace(cameras={"front": EPISODES, "side": EPISODES}),
        alignment=SimpleNamespace(cameras={"front": FixedCamera(camera=VIDEO, clock=None)}),
    )
    monkeypatch.setattr(run_cameras, "results_of", lambda project, stages: results)
    return Project(capture=tmp_path, out=tmp_path)


def test_cameras_of_video_episodes_and_scan_have_names(project: Project) -> None:
    assert run_cameras.find_camera(project, "front") is VIDEO
    assert run_cameras.find_camera(project, "side") is EPISODES
    assert run_cameras.find_camera(project, "0001.jpg") is SCAN


def test_an_unknown_camera_lists_the_known_ones(project: Project) -> None:
    with pytest.raises(
        ConfigError, match=r"'back' .*known: front, side, and scan images from 0000.jpg to 0001.jpg"
    ):
        run_cameras.find_camera(project, "back")


def test_before_the_replacement_there_are_the_recording_s_cameras(project: Project) -> None:
    (project.out / "07_replacement").rmdir()
    with pytest.raises(ConfigError, match="known: front, and scan images"):
        run_cameras.find_camera(project, "side")
