"""Exported files alone are enough to open an object again, in a scene that is not ours."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.assets.mjcf import holding_friction
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import write_usd
from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import FittedAsset
from aomgen.core.recording import RobotChoice
from aomgen.core.transforms import apply, invert
from aomgen.datasets.features import ee_targets, feature_columns, last_targets
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.record import episode_of
from aomgen.episodes.variations import Ranges
from aomgen.errors import MissingFileError
from aomgen.io.episode_folder import commit_episode, read_episode
from aomgen.io.video import encode_video
from aomgen.robots.loading import save_robot
from aomgen.robots.robot import RobotModel
from benchmarks.exported import OPENED_SHARE, Replay
from benchmarks.foreign_scene import foreign_scene
from benchmarks.replay_exported import exported_episodes, run_replay
from synthetic.demonstration_search import Performance, find_demonstration
from verified import verified_episodes

FPS = 10
# A part that slides, a lid that its friction holds, and a door.
CATEGORIES = ("drawer", "laptop", "microwave")


def demonstration(robot: RobotModel, shown: Performance) -> Demonstration:
    """A simulated demonstration as the pipeline recovers it, without any error."""
    simulated, joint = shown.demonstration, shown.joint
    frames = np.searchsorted(simulated.times_s, np.arange(int(simulated.times_s[-1] * FPS)) / FPS)
    times, thetas = simulated.times_s[frames], shown.theta[frames]
    moving = np.flatnonzero((thetas > 0.01 * thetas.max()) & (thetas < 0.99 * thetas.max()))
    start, end = moving[0] - 1, moving[-1] + 1
    poses = robot.ee_poses(simulated.joints[frames])
    held = apply(shown.layout.T_world_object, shown.layout.asset.handle_point)
    return Demonstration(
        times_s=times,
        joints=simulated.joints[frames],
        gripper=np.clip(simulated.gripper[frames], 0, 1),
        Ts_world_ee=poses,
        thetas=np.clip(thetas, 0, None),
        start_s=float(times[start]),
        end_s=float(times[end]),
        joint=joint,
        grasp_ee=apply(invert(poses[start]), held),
        ee_turn_ratio=shown.style.follow if joint.type == "revolute" else 0.0,
    )


def fitted_at(shown: Performance, demo: Demonstration) -> FittedAsset:
    """The demonstrated object itself."""
    frames = demo.contact_frames
    thetas = np.maximum.accumulate(demo.thetas[frames])
    return FittedAsset(
        asset=shown.layout.asset,
        T_world_asset=shown.layout.T_world_object,
        contact_asset=shown.layout.asset.handle_point,
        shares=np.linspace(0, 1, len(frames)),
        thetas=thetas - thetas[0],
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )


def export(robot: RobotModel, category: str, out: Path) -> None:
    """One verified episode of a category, in the folders of a finished run; its pictures are grey."""
    shown = find_demonstration(robot, make_asset(category, 1), np.random.default_rng(3))
    demo = demonstration(robot, shown)
    fitted = fitted_at(shown, demo)
    ranges = Ranges(x_m=(-0.01, 0.01), y_m=(-0.01, 0.01), yaw_deg=(-3, 3))
    support = SupportPlane(
        height=float(shown.layout.T_world_object[2, 3]), low_xy=[-np.inf] * 2, high_xy=[np.inf] * 2
    )
    made = next(verified_episodes(fitted, demo, robot, support, ranges, FPS))
    T_world_cam = look_at((1, 1, 1), (0, 0, 0))
    camera = Camera(fx=60, fy=60, cx=32, cy=32, width=64, height=64, T_world_cam=T_world_cam)
    episode = episode_of(
        made,
        0,
        Path("../../asset.usda"),
        robot,
        f"open the {category}",
        {"front": camera},
        np.zeros(6),
    )
    episode = replace(episode, visible={"front": np.ones((len(episode), 5), bool)})
    grey = encode_video(np.full((len(episode), 64, 64, 3), 128, np.uint8), FPS)
    folder = commit_episode(out / "08_episodes", episode, {"front": grey})
    write_usd(fitted.asset, out / "asset.usda")
    write_lerobot_v3([folder], out / "dataset")
    choice = RobotChoice(
        model=robot.name,
        model_file=None,
        root=out,
        references=(),
        base_frame="base_link",
        joints=robot.joint_names,
        scan_joints=demo.joints[0],
        scan_gripper=0.0,
    )
    (out / "06_twin").mkdir()
    save_robot(out / "06_twin", choice)


@pytest.fixture(scope="module", params=CATEGORIES)
def out(robot: RobotModel, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    export(robot, request.param, folder)
    return folder


def test_exported_actions_open_the_exported_object(out: Path) -> None:
    ((category, figures),) = run_replay([out]).items()
    assert (figures["episodes"], figures["opened"]) == (1, 1), category
    assert (figures["opened_by_ee_absolute"], figures["opened_by_ee_delta"]) == (1, 1)
    assert figures["opened_when_moved"] == 0
    limit = {"deg": 3.0, "mm": 5.0}[figures["unit"]]
    assert figures["theta_worst"] < limit
    assert figures["final_error"] < limit


def test_a_lid_falls_where_the_file_does_not_state_its_friction(robot: RobotModel, out: Path) -> None:
    usd, asset = out / "asset.usda", read_usd(out / "asset.usda")
    text = usd.read_text()
    usd.write_text(re.sub(r"(mjc:frictionloss) = [0-9.]+", r"\1 = 0.15", text))
    (episode,) = exported_episodes(out)
    scene = foreign_scene(robot, episode.usd, episode.T_world_object)
    usd.write_text(text)
    thetas = Replay(scene, robot, episode).run().thetas
    opened = episode.shares(thetas)[-1] >= OPENED_SHARE
    assert opened == (holding_friction(asset) == 0)


def test_actions_are_what_is_reached_one_frame_later(robot: RobotModel, out: Path) -> None:
    episode = read_episode(out / "08_episodes" / "000000").episode
    columns = feature_columns(episode)
    arm = slice(0, len(robot.joint_names))
    states, actions = columns["observation.state"][:, arm], columns["action"][:, arm]
    step = np.abs(np.diff(states, axis=0)).mean()
    assert 0.8 < np.abs(actions - states).mean() / step < 1.2
    tracking_mm = max(run["tracking_mm"] for run in episode.verdict["dynamic"])
    missed = np.linalg.norm(episode.Ts_world_ee_action[:-1, :3, 3] - episode.Ts_world_ee[1:, :3, 3], axis=1)
    assert 1000 * missed.max() <= tracking_mm + 0.5
    deltas = columns["annotation.action.ee_delta"].astype(np.float32)
    reached = ee_targets(last_targets(episode), deltas.astype(np.float64))[:, :3, 3]
    assert 1000 * np.abs(reached - columns["annotation.action.ee_absolute"][:, :3]).max() < 0.01


def test_an_unfinished_run_is_named(tmp_path: Path) -> None:
    (tmp_path / "06_twin").mkdir()
    with pytest.raises(MissingFileError):
        run_replay([tmp_path])
