"""Two more real arms from public packages: Franka Panda and xArm7, as their makers' MJCF has them.

Each is loaded as guessed and as its description in `examples/robots` says. Run as
`python tests/robots_check.py FOLDER`, where FOLDER holds the wheels of gymnasium-robotics and gym-xarm;
`make robots-test` fetches them. `python -m synthetic CAPTURE --robot FOLDER/.../robot_alone.xml` then records a
capture with the Panda.
"""

import shutil
import sys
import zipfile
from pathlib import Path

import mujoco
import numpy as np

from aomgen.core.transforms import apply, invert
from aomgen.robots.description import FILE_NAME
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel

PANDA = """<mujoco model="panda">
  <include file="franka_assets/assets.xml"/>
  <worldbody><include file="franka_assets/chain.xml"/></worldbody>
  <include file="franka_assets/actuator.xml"/>
</mujoco>"""
DESCRIPTIONS = Path(__file__).parents[1] / "examples" / "robots"
# Arm joints, and how far the pads open according to the makers' data sheets, [m].
EXPECTED = {"panda": (7, 0.08), "xarm7": (7, 0.084)}


def unpacked(folder: Path) -> dict[str, Path]:
    """The robots' files; the Panda's parts come without one that holds the robot alone."""
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    panda = next(folder.rglob("franka_assets")).parent / "robot_alone.xml"
    panda.write_text(PANDA)
    # A whole task with table, cube and goals, of which only the robot is taken.
    return {"panda": panda, "xarm7": next(folder.rglob("lift.xml"))}


def check(name: str, robot: RobotModel) -> None:
    count, opening_m = EXPECTED[name]
    low, high = np.clip(robot.joint_limits, -np.pi, np.pi).T
    joints = (low + high)[None] / 2
    assert len(robot.joint_names) == count, robot.joint_names
    gaps = []
    for gripper in (0.0, 0.5, 1.0):
        poses = robot.link_poses(joints, [gripper])[0]
        left, right = (apply(poses[pad.body], pad.face_body) for pad in robot.pads)
        gaps.append(float(np.linalg.norm(left - right)))
    assert gaps[0] > gaps[1] > gaps[2], gaps
    assert abs(gaps[0] - gaps[2] - opening_m) < 0.006, gaps
    tip = apply(invert(poses[robot.body_names.index(robot.hand_bodies[0])]), robot.ee_poses(joints)[0][:3, 3])
    assert np.linalg.norm(tip) < 0.3
    hold(robot, joints)


def hold(robot: RobotModel, joints: np.ndarray) -> None:
    """The servos keep the arm where it is, to a degree, while the hand closes."""
    model = robot.spec(visual=False).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.qpos(joints, [0.0])[0]
    for joint, value in zip(robot.joint_names, joints[0], strict=True):
        data.ctrl[model.actuator(f"servo_{joint}").id] = value
    assert robot.drive is not None
    data.ctrl[model.actuator(robot.drive.actuator).id] = robot.drive.control_range[1]
    mujoco.mj_step(model, data, 1000)
    now = data.qpos[[model.joint(joint).qposadr[0] for joint in robot.joint_names]]
    assert np.abs(now - joints[0]).max() < np.radians(1.0), now - joints[0]


def main() -> None:
    files = unpacked(Path(sys.argv[1]))
    for name, path in files.items():
        described = path.parent / FILE_NAME
        described.unlink(missing_ok=True)
        check(name, load_robot(path))
        shutil.copy(DESCRIPTIONS / f"{name}.toml", described)
        check(name, load_robot(path))
    sys.stdout.write(f"{', '.join(files)}: arm, fingers, pads and servos as their makers have them\n")


if __name__ == "__main__":
    main()
