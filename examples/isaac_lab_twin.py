"""Replay an episode by physics in NVIDIA Isaac Lab, in the scene that `aomgen export OUT scene.usdc --episode N` wrote.

    ./isaaclab.sh -p isaac_lab_twin.py scene.usdc

This script was never run in Isaac Lab, for lack of one. `read_commands`, which needs OpenUSD alone, is tested; the code that
drives the simulator follows the names of Isaac Lab 2. Please report necessary changes. The scene's drives have the gains of
MuJoCo's model, so that PhysX may want others.
"""

# Isaac Lab comes with its own Python.
# pyright: reportMissingImports=false

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

SCENE_PRIM = "/World/Twin"
# Physics steps a second, at least; a frame lasts a whole number of them.
PHYSICS_HZ = 240


class Commands(NamedTuple):
    """Commanded positions and velocities (T + 1, J) of named joints at every frame, radians or metres and seconds."""

    joints: list[str]
    positions: np.ndarray
    velocities: np.ndarray
    fps: float


def read_commands(path: Path) -> Commands:
    """Read the targets of all drives that the scene's time samples move."""
    from pxr import Usd, UsdPhysics

    stage = Usd.Stage.Open(str(path))
    frames = range(int(stage.GetEndTimeCode()) + 2)
    names, positions, velocities = [], [], []
    for prim in stage.Traverse():
        for axis, unit in (("angular", np.pi / 180), ("linear", 1.0)):
            drive = UsdPhysics.DriveAPI.Get(prim, axis)
            if drive and drive.GetTargetPositionAttr().GetNumTimeSamples():
                names.append(prim.GetName())
                positions.append([unit * drive.GetTargetPositionAttr().Get(frame) for frame in frames])
                velocities.append([unit * drive.GetTargetVelocityAttr().Get(frame) for frame in frames])
    fps = stage.GetTimeCodesPerSecond()
    return Commands(names, np.array(positions).T, np.array(velocities).T, fps)


def main() -> None:
    """Start the simulator, drive the robot, and print the final value of the object's joint."""
    parser = argparse.ArgumentParser(description="Replay an episode of AOMGen in Isaac Lab.")
    parser.add_argument("scene", type=Path)
    args = parser.parse_args()
    from isaaclab.app import AppLauncher

    app = AppLauncher(headless=False).app
    # Isaac Lab's modules can be imported only once the application runs.
    import isaaclab.sim as sim_utils
    import torch
    from isaaclab.actuators import ImplicitActuatorCfg
    from isaaclab.assets import Articulation, ArticulationCfg

    commands = read_commands(args.scene)
    steps = int(np.ceil(PHYSICS_HZ / commands.fps))
    dt = 1 / (commands.fps * steps)
    simulation = sim_utils.SimulationContext(sim_utils.SimulationCfg(dt=dt))
    scene = sim_utils.UsdFileCfg(usd_path=str(args.scene.resolve()), variants={"motion": "physics"})
    scene.func(SCENE_PRIM, scene)
    # Gains of None are those of the scene.
    drives = {"all": ImplicitActuatorCfg(joint_names_expr=[".*"], stiffness=None, damping=None)}
    robot = Articulation(ArticulationCfg(prim_path=f"{SCENE_PRIM}/Robot", spawn=None, actuators=drives))
    opened = Articulation(ArticulationCfg(prim_path=f"{SCENE_PRIM}/Object", spawn=None, actuators={}))
    simulation.reset()
    indices, names = robot.find_joints(commands.joints)
    columns = [commands.joints.index(name) for name in names]
    positions = torch.tensor(commands.positions[:, columns], dtype=torch.float32, device=robot.device)
    velocities = torch.tensor(commands.velocities[:, columns], dtype=torch.float32, device=robot.device)
    robot.write_joint_state_to_sim(positions[:1], torch.zeros_like(positions[:1]), joint_ids=indices)
    for frame in range(len(positions) - 1):
        for step in range(steps):
            share = step / steps
            target = (1 - share) * positions[frame : frame + 1] + share * positions[frame + 1 : frame + 2]
            robot.set_joint_position_target(target, joint_ids=indices)
            robot.set_joint_velocity_target(velocities[frame : frame + 1], joint_ids=indices)
            robot.write_data_to_sim()
            simulation.step(render=step == 0)
            robot.update(dt)
            opened.update(dt)
    print(f"object joint: {float(opened.data.joint_pos[0, 0]):.4f}")
    app.close()


if __name__ == "__main__":
    main()
