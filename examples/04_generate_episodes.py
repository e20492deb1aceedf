"""From one demonstration to verified episodes in LeRobot's format: python examples/04_generate_episodes.py FOLDER

A simulated robot opens a drawer once. The demonstration is carried to other poses of the drawer, the arm is solved, each
plan is verified in contact simulation, and what passed is exported. Pictures are left grey: `aomgen run` renders them
from the twin.
"""

import argparse
import sys
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from aomgen.assets.choice import make_asset
from aomgen.assets.usd_write import write_usd
from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, VerifiedEpisode
from aomgen.core.transforms import apply, invert
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.record import episode_of
from aomgen.episodes.variations import Ranges, draw
from aomgen.io.episode_folder import commit_episode
from aomgen.io.video import encode_video
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from aomgen.simulation.verify import verify_plan

# Where `synthetic` lies, which is no part of the installed package.
sys.path.insert(0, str(Path(__file__).parents[1]))
from synthetic.demonstration_search import Performance, find_demonstration

FPS = 10


def recorded(robot: RobotModel, shown: Performance) -> Demonstration:
    """What the motion stage recovers, here taken from the simulation."""
    run = shown.demonstration
    frames = np.searchsorted(run.times_s, np.arange(int(run.times_s[-1] * FPS)) / FPS)
    thetas = np.maximum(shown.theta[frames], 0)
    moving = np.flatnonzero((thetas > 0.01 * thetas.max()) & (thetas < 0.99 * thetas.max()))
    start, end = moving[0] - 1, moving[-1] + 1
    poses = robot.ee_poses(run.joints[frames])
    held = apply(shown.layout.T_world_object, shown.layout.asset.handle_point)
    return Demonstration(
        times_s=run.times_s[frames], joints=run.joints[frames], gripper=np.clip(run.gripper[frames], 0.0, 1.0),
        Ts_world_ee=poses, thetas=thetas, start_s=float(run.times_s[frames][start]),
        end_s=float(run.times_s[frames][end]), joint=shown.joint,
        grasp_ee=apply(invert(poses[start]), held), ee_turn_ratio=0.0,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=3)
    options = parser.parse_args()
    robot = load_robot("ur5e_2f85")
    shown = find_demonstration(robot, make_asset("drawer", 1), np.random.default_rng(3))
    demo, asset, T_world_asset = recorded(robot, shown), shown.layout.asset, shown.layout.T_world_object

    thetas = np.maximum.accumulate(demo.thetas[demo.contact_frames])
    fitted = FittedAsset(
        asset=asset, T_world_asset=T_world_asset, contact_asset=asset.handle_point, scale=1.0, mirrored=False,
        shares=np.arange(len(thetas)) / (len(thetas) - 1), thetas=thetas - thetas[0], mode="trajectory", residual_mm=0.0,
    )  # fmt: skip
    endless = np.full(2, np.inf)
    table = SupportPlane(height=float(T_world_asset[2, 3]), low_xy=-endless, high_xy=endless)
    solver, scene = ik_solver(robot), build_scene(robot, asset, T_world_asset, table)
    made: list[VerifiedEpisode] = []
    for tried in count(1):
        variation = draw(seed=0, asset=0, index=tried - 1, ranges=Ranges())
        plan = plan_episode(fitted, demo, variation, scene, solver, PlanParams(fps=FPS))
        result = verify_plan(plan, scene) if isinstance(plan, EpisodePlan) else plan
        if isinstance(result, VerifiedEpisode):
            made.append(result)
        else:
            print(f"draw {variation.index} rejected, {result.reason}: {result.detail}")
        if len(made) == options.episodes:
            break
    print(f"{len(made)} episodes verified, {tried - len(made)} draws rejected")

    write_usd(asset, options.folder / "asset.usda")
    camera = Camera(
        fx=60, fy=60, cx=32, cy=32, width=64, height=64, T_world_cam=look_at((1, 1, 1), (0, 0, 0))
    )
    folders = []
    for index, verified in enumerate(made):
        usd = Path("../../asset.usda")
        episode = episode_of(verified, index, usd, robot, "open the drawer", {"front": camera}, np.zeros(6))
        grey = encode_video(np.full((len(episode), 64, 64, 3), 128, np.uint8), FPS)
        folders.append(commit_episode(options.folder / "episodes", episode, {"front": grey}))
    write_lerobot_v3(folders, options.folder / "dataset")

    rows = pq.read_table(next((options.folder / "dataset" / "data").rglob("*.parquet")))
    state, action = (np.stack(rows[name].to_numpy()) for name in ("observation.state", "action"))
    joints = slice(0, len(robot.joint_names))
    tracked_rad = np.abs(state[1:, joints] - action[:-1, joints])[rows["episode_index"].to_numpy()[1:] == 0]
    print(f"{len(state)} frames; the arm follows its targets within {np.degrees(tracked_rad.max()):.2f} deg")
    assert len(made) == options.episodes
    assert np.median(tracked_rad) < np.radians(0.5)


if __name__ == "__main__":
    main()
