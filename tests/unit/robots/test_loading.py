"""A robot kept beside results must come back the same, without the capture, or not at all."""

import json
import shutil

import numpy as np
import pytest

from aomgen.core.recording import RobotChoice
from aomgen.errors import MalformedFileError, MissingFileError, UnsafePathError
from aomgen.robots.loading import choose_robot, load_stored_robot, save_robot


@pytest.fixture
def choice(write_urdf):
    path = write_urdf()
    return RobotChoice(
        model="",
        model_file=path,
        root=path.parent,
        references=(),
        base_frame="ur_base",
        joints=("wrist", "elbow", "shoulder"),
        scan_joints=np.zeros(3),
        scan_gripper=0.0,
    )


def test_a_stored_robot_needs_nothing_of_the_capture(choice, tmp_path):
    robot = choose_robot(choice)
    folder = tmp_path / "twin"
    folder.mkdir()
    save_robot(folder, choice)
    choice.model_file.unlink()
    shutil.move(folder, tmp_path / "elsewhere")
    stored = load_stored_robot(tmp_path / "elsewhere")
    joints, gripper = np.array([[0.2, -0.4, 1.1]]), [0.7]
    assert stored.joint_names == robot.joint_names
    assert stored.ee_poses(joints) == pytest.approx(robot.ee_poses(joints), abs=1e-12)
    assert stored.link_poses(joints, gripper) == pytest.approx(robot.link_poses(joints, gripper), abs=1e-12)


def test_damaged_headers_are_refused(choice, tmp_path):
    save_robot(tmp_path, choice)
    header = tmp_path / "robot.json"
    good = json.loads(header.read_text())

    def stored(**changes):
        header.write_text(json.dumps({**good, "value": {**good["value"], **changes}}))
        return load_stored_robot(tmp_path)

    with pytest.raises(UnsafePathError):
        stored(file="../robot.urdf")
    with pytest.raises(MissingFileError):
        stored(file="robot/absent.urdf")
    with pytest.raises(MalformedFileError, match="StoredRobot"):
        stored(joints=3)
    header.write_text("{}")
    with pytest.raises(MalformedFileError, match="StoredRobot"):
        load_stored_robot(tmp_path)
    header.unlink()
    with pytest.raises(MissingFileError):
        load_stored_robot(tmp_path)
