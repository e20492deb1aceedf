"""A folder with the files of a capture gets a capture.toml that `aomgen prompts` continues with."""

import socket
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest

from aomgen.capture.capture_schema import read_manifest
from aomgen.errors import MalformedFileError, MissingFileError, UnknownNameError
from aomgen.importers.csv_tables import UR_JOINTS
from aomgen.importers.found_files import describe_capture, find_capture_files
from aomgen.prompting.session import PromptSession
from command_line import aomgen, one_sentence


@pytest.fixture
def files(capture_copy: Path) -> Path:
    (capture_copy / "capture.toml").unlink()
    return capture_copy


def rename_column(capture: Path, old: str, new: str) -> None:
    log = capture / "demo" / "joints.csv"
    log.write_text(log.read_text("utf-8").replace(old, new, 1), "utf-8")


def test_confirmed_questions_describe_the_bundled_files(files: Path, sample: Path, monkeypatch):
    monkeypatch.setattr("sys.stdin", StringIO("\n\n\n"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        result = aomgen("prompts", files, "--port", taken.getsockname()[1], "--no-browser", folder=files)
    one_sentence(result, 2, "--port")
    found, want = read_manifest(files / "capture.toml"), read_manifest(sample / "capture.toml")
    assert found.robot == want.robot
    assert found.scan.images == want.scan.images
    assert [camera.video for camera in found.demo.cameras] == ["demo/front.mp4"]
    session = PromptSession(files)
    assert session.stated == {"category": "", "instruction": ""}
    assert session.describe()["prompts"] == []


def test_another_gripper_and_robot_are_stated(files: Path):
    rename_column(files, "gripper", "register_24")
    found, columns = find_capture_files(files)
    assert found.gripper == ""
    tables = replace(found, robot_model="robot/arm.urdf", gripper="register_24")
    path = describe_capture(files, tables, columns)
    robot = read_manifest(path).robot
    assert (robot.model, robot.urdf, robot.gripper) == ("", "robot/arm.urdf", "register_24")


def test_joints_of_another_robot_are_not_recognised(files: Path):
    rename_column(files, "elbow_joint", "q3")
    found, columns = find_capture_files(files)
    assert (found.robot_model, found.joints, found.gripper) == ("", (), "gripper")
    assert "q3" in columns
    with pytest.raises(UnknownNameError, match="elbow_joint"):
        describe_capture(files, replace(found, joints=["elbow_joint"]), columns)
    assert not (files / "capture.toml").exists()


@pytest.mark.parametrize(("name", "word"), [("scan", "import scan"), ("demo", "import demo")])
def test_missing_files_name_the_import(files: Path, name: str, word: str):
    (files / name).rename(files / "elsewhere")
    with pytest.raises(MissingFileError, match=word):
        find_capture_files(files)


def test_an_rtde_recording_is_to_be_imported(files: Path):
    for number, joint in enumerate(UR_JOINTS):
        rename_column(files, joint, f"actual_q_{number}")
    with pytest.raises(MalformedFileError, match=r"is an RTDE recording.*aomgen import demo FILE"):
        find_capture_files(files)
