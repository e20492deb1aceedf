"""Replay a generated episode in NVIDIA Isaac Sim.

    ./python.sh replay_in_isaac_sim.py EPISODE ROBOT.usd --gripper finger_joint 0.0 0.8

This script was never run in Isaac Sim. The functions that read the files are tested; the code that drives the
simulator uses the interfaces of Isaac Sim 4.5 and 5. Please report necessary changes.

EPISODE is a folder with `episode.json`, which names the object's USD file, and `frames.npz`. ROBOT.usd is a USD file of
the robot with a fixed base: its root is the world frame of the episode, its arm joints have the names and zero positions
of the episode, and its drives are stiff enough to follow the commands. `--gripper` names the joint that closes the
gripper, and its values when the gripper is open and closed, [rad] or [m].
"""

# The modules of Isaac Sim exist only in the Python interpreter that it includes.
# pyright: reportMissingImports=false

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Smallest rate of commands, [Hz]; the rate used is a multiple of the frame rate.
CONTROL_HZ = 125
# Time for which the arm holds its first configuration before the episode begins, [s].
SETTLE_S = 0.2
EPISODE_FILE, FRAMES_FILE = "episode.json", "frames.npz"
ROBOT_PRIM, OBJECT_PRIM = "/World/Robot", "/World/Object"


class Replayed(NamedTuple):
    """Content of an episode with T frames and J arm joints, in meters, radians and seconds.

    `commands` (T + 1, J + 1) holds the arm joints and the gripper (0 open .. 1 closed) at the beginning of each frame and
    at the end of the last one. `T_world_object` (4, 4) is the pose of the USD file's root, and `thetas` (T,) are the values
    of the object's joint.
    """

    usd: Path
    fps: int
    joint_names: list[str]
    T_world_object: NDArray[np.float64]
    commands: NDArray[np.float64]
    thetas: NDArray[np.float64]


def read_recording(folder: Path) -> Replayed:
    """Read an episode from its folder."""
    described = json.loads((folder / EPISODE_FILE).read_text(encoding="utf-8"))
    with np.load(folder / FRAMES_FILE, allow_pickle=False) as frames:
        states = np.column_stack([frames["joints"], frames["gripper"]])
        actions = np.column_stack([frames["action_joints"], frames["action_gripper"]])
        thetas = frames["thetas"]
    return Replayed(
        usd=(folder / described["asset_usd"]).resolve(),
        fps=described["fps"],
        joint_names=described["joint_names"],
        T_world_object=np.array(described["T_world_object"]),
        # Action t is reached at frame t + 1.
        commands=np.concatenate([states[:1], actions]),
        thetas=thetas,
    )


def plan_control(
    recording: Replayed, gripper: tuple[float, float], rate: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute joint targets and their velocities, each (N, J + 1), [rad] or [m] and per second.

    The robot holds its first configuration for SETTLE_S, then commands are interpolated linearly. The last column is the
    joint that closes the gripper.

    Args:
        recording: Episode to be replayed.
        gripper: Values of the gripper's joint when it is open and closed.
        rate: Rate of the targets, [Hz], a multiple of the frame rate.
    """
    frames = np.arange(len(recording.commands))
    steps = np.arange(frames[-1] * rate // recording.fps + 1) * recording.fps / rate
    moving = np.stack([np.interp(steps, frames, column) for column in recording.commands.T], 1)
    targets = np.concatenate([np.repeat(moving[:1], round(SETTLE_S * rate), 0), moving])
    targets[:, -1] = gripper[0] + targets[:, -1] * (gripper[1] - gripper[0])
    return targets, np.diff(targets, axis=0, append=targets[-1:]) * rate


def quaternion_wxyz(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a rotation (3, 3) to a unit quaternion (4,), real part first, as the eigenvector of Bar-Itzhack's matrix."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.ravel()
    K = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    quat = np.linalg.eigh(K)[1][:, -1]
    return quat if quat[0] >= 0 else -quat


def main() -> None:
    """Replay the episode named on the command line."""
    parser = argparse.ArgumentParser(description="Replay a generated episode in Isaac Sim.")
    parser.add_argument("episode", type=Path)
    parser.add_argument("robot", type=Path, help="USD file of the robot, its gripper included")
    parser.add_argument("--gripper", nargs=3, required=True, metavar=("JOINT", "OPEN", "CLOSED"))
    args = parser.parse_args()
    recording = read_recording(args.episode)
    replay(recording, args.robot, args.gripper[0], (float(args.gripper[1]), float(args.gripper[2])))


def replay(recording: Replayed, robot_usd: Path, gripper_joint: str, gripper: tuple[float, float]) -> None:
    """Build the scene, drive the robot through a recording, and print the final value of the object's joint.

    Args:
        recording: Episode to be replayed.
        robot_usd: USD file of the robot.
        gripper_joint: Name of the joint that closes the gripper.
        gripper: Values of this joint when the gripper is open and closed, [rad] or [m].
    """
    from isaacsim import SimulationApp

    app = SimulationApp({"headless": False})
    # Isaac Sim's modules can be imported only once the application runs.
    from isaacsim.core.api import World
    from isaacsim.core.prims import SingleArticulation
    from isaacsim.core.utils.stage import add_reference_to_stage
    from isaacsim.core.utils.types import ArticulationAction

    count = -(-CONTROL_HZ // recording.fps)
    rate = recording.fps * count
    world = World(stage_units_in_meters=1.0, physics_dt=1 / rate, rendering_dt=1 / recording.fps)
    add_reference_to_stage(str(robot_usd), ROBOT_PRIM)
    _fix_to_world(add_reference_to_stage(str(recording.usd), OBJECT_PRIM), recording.T_world_object)
    robot = world.scene.add(SingleArticulation(ROBOT_PRIM, name="robot"))
    thing = world.scene.add(SingleArticulation(OBJECT_PRIM, name="object"))
    world.reset()
    indices = np.array([robot.get_dof_index(name) for name in [*recording.joint_names, gripper_joint]])
    targets, velocities = plan_control(recording, gripper, rate)
    robot.set_joint_positions(targets[0], joint_indices=indices)
    thing.set_joint_positions(recording.thetas[:1])
    for step, (target, velocity) in enumerate(zip(targets, velocities, strict=True)):
        action = ArticulationAction(joint_positions=target, joint_velocities=velocity, joint_indices=indices)
        robot.apply_action(action)
        # A step with rendering would advance physics by a whole frame.
        world.step(render=False)
        if step % count == 0:
            world.render()
    print(f"object joint: {thing.get_joint_positions()[0]:.4f}, recorded {recording.thetas[-1]:.4f}")
    app.close()


def _fix_to_world(root: Any, T_world_object: NDArray[np.float64]) -> None:
    """Set the pose of the object's root prim, and fix its static link to the world."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    # USD uses row vectors, so its matrices are transposed.
    place = Gf.Matrix4d(T_world_object.T.tolist())
    xform = UsdGeom.Xformable(root)
    xform.ClearXformOpOrder()
    xform.AddTransformOp().Set(place)
    joint = next(UsdPhysics.Joint(prim) for prim in Usd.PrimRange(root) if prim.IsA(UsdPhysics.Joint))
    base = UsdPhysics.FixedJoint.Define(root.GetStage(), f"{OBJECT_PRIM}Base")
    base.CreateBody1Rel().SetTargets(joint.GetBody0Rel().GetTargets())
    base.CreateLocalPos0Attr(Gf.Vec3f(*T_world_object[:3, 3].tolist()))
    base.CreateLocalRot0Attr(Gf.Quatf(*quaternion_wxyz(T_world_object[:3, :3]).tolist()))


if __name__ == "__main__":
    main()
