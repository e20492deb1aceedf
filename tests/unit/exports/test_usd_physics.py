"""Drives of a gripper whose second finger follows the first: both are told to close."""

from pathlib import Path

import pytest

from aomgen.assets.choice import make_asset
from aomgen.exports.usd_physics import find_actuated_joints, find_coupled_joints, find_drives
from aomgen.robots.loading import load_robot
from aomgen.simulation.scene import Scene, build_scene
from small_robot import urdf_text
from toy_plans import SUPPORT, facing_robot


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    file: Path = tmp_path_factory.mktemp("robot") / "small.urdf"
    file.write_text(urdf_text())
    asset = make_asset("drawer", 1)
    return build_scene(load_robot(file), asset, facing_robot(asset, (0.6, 0.0)), SUPPORT)


def test_the_second_finger_follows(scene: Scene) -> None:
    model = scene.model
    first, second = (model.joint(name).id for name in ("slide_a", "slide_b"))
    actuated = find_actuated_joints(model, model.actuator(scene.gripper.actuator).id)
    assert actuated == {first: 1.0}
    leader, offset, ratio = find_coupled_joints(model, actuated)[second]
    assert (leader, ratio) == (first, pytest.approx(1.0))
    assert offset == pytest.approx(0.0)
    drives = find_drives(scene)
    assert drives[second] == drives[first]
    arm = {model.joint(name).id for name in scene.robot.joint_names}
    assert set(drives) == {*arm, first, second}
