"""A finished run of the toy scene, whose recording is the small capture's."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.core.alignment import Clock, FixedCamera
from aomgen.core.camera import look_at
from aomgen.core.demonstration import EpisodeScene, SupportPlane
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.joint import Joint
from aomgen.core.keypoints import find_keypoints
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.parts import Parts, no_cut
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.project import Project
from aomgen.core.structure import Structure
from aomgen.core.transforms import apply
from aomgen.episodes.render import render_episode, static_layers
from aomgen.io.artifact import save_artifact
from aomgen.io.episode_folder import commit_episode, read_episode
from aomgen.io.ply import write_gaussians
from aomgen.io.video import encode_video
from aomgen.parts.survey import Coverage, Survey
from aomgen.pipeline.manifest import write_manifest
from aomgen.pipeline.project_file import write_project
from aomgen.pipeline.stages import STAGES
from aomgen.results import FITTED, GAUSSIANS_FILE
from aomgen.robots.loading import save_robot
from aomgen.twin.binding import with_object
from aomgen.viewing.opened import ViewedFolder
from small_alignment import ALIGNMENT

FRAMES = 5
FOLDERS = {stage.name: stage.folder for stage in STAGES}


@pytest.fixture(scope="session")
def finished_toy_run(toy_scene, small_capture: Path, tmp_path_factory) -> Path:
    """Written once; read only."""
    out = tmp_path_factory.mktemp("viewed") / "run"
    out.mkdir()
    write_project(out / "project.toml", Project(capture=small_capture, out=out))
    homes = {name: out / folder for name, folder in FOLDERS.items()}
    for home in homes.values():
        home.mkdir()
    scan = {f"{k}.jpg": toy_scene.camera.move(look_at((-0.5, y, 0.8), (0.6, 0, 0.1))) for k, y in enumerate((-0.8, -0.5, 0.0))}  # fmt: skip
    cameras = {"front": toy_scene.camera}
    save_artifact(
        homes["structure"],
        "structure",
        Structure(
            cameras_recon=scan,
            demo_cameras_recon=cameras,
            dropped={},
            points_recon=toy_scene.gaussians.means[::100],
            colors_srgb=np.zeros((len(toy_scene.gaussians.means[::100]), 3), np.uint8),
            observations=np.zeros((0, 2), np.int32),
            reprojection_error_px=0.5,
        ),
    )
    write_gaussians(homes["gaussians"] / GAUSSIANS_FILE, toy_scene.gaussians)
    fixed = FixedCamera(camera=toy_scene.camera, clock=Clock(offset_s=0.0))
    save_artifact(
        homes["alignment"],
        "alignment",
        replace(
            ALIGNMENT,
            joint_zeros_rad=np.zeros(6),
            joint_zero_sds_rad=np.zeros(6),
            cameras={"front": fixed},
        ),
    )
    count, twin = len(toy_scene.gaussians), toy_scene.twin
    save_artifact(
        homes["parts"],
        "parts",
        Parts(
            labels=toy_scene.labels,
            robot_bodies=np.full(count, -1, np.int32),
            cut=no_cut(toy_scene.gaussians),
            method="boxes",
            box_misfit=0.0,
            static_agreement=1.0,
            moving_agreement=1.0,
        ),
    )
    save_artifact(homes["parts"], "coverage", survey())
    save_artifact(homes["motion"], "motion", motion(toy_scene, twin.joint.move(twin.T_world_object)))
    save_artifact(homes["twin"], "twin", twin)
    save_robot(homes["twin"], read_capture(small_capture).robot)
    write_replacement(toy_scene, homes["replacement"], cameras)
    write_episode(toy_scene, homes, cameras)
    for stage in STAGES:
        write_manifest(homes[stage.name], stage.name, (stage.version, {}, {}), {})
    return out


@pytest.fixture(scope="session")
def viewed(finished_toy_run: Path) -> ViewedFolder:
    """The finished run; opened once, because each robot and each scene takes seconds."""
    return ViewedFolder(finished_toy_run)


@pytest.fixture
def toy_run_copy(finished_toy_run: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(finished_toy_run, tmp_path / "run"))


@pytest.fixture
def toy_motion(toy_scene) -> Callable[[Joint], MotionEstimate]:
    """Makes the estimate of a joint."""
    return lambda joint: motion(toy_scene, joint)


@pytest.fixture
def toy_survey() -> Survey:
    return survey()


@pytest.fixture
def toy_episode_7(finished_toy_run: Path) -> Episode:
    return read_episode(finished_toy_run / FOLDERS["episodes"] / "000007").episode


def survey() -> Survey:
    """The far side of the object, away from the robot, was never seen."""
    points = np.array([[0.4, -0.1, 0.1], [0.9, -0.1, 0.1]])
    return Survey(
        names=("the near side of the object", "the far side of the object"),
        points_world=points,
        sides=np.array([0, 1], np.int32),
        coverage=Coverage(views=np.array([9, 0], np.uint16), spread_deg=np.array([60, 0], np.float32)),
    )


def motion(toy_scene, joint: Joint) -> MotionEstimate:
    times = np.arange(48) / 5
    ramp = np.clip(times - 3, 0, 2) / 2
    point = toy_scene.twin.T_world_object[:3, 3] + [-0.2, 0, 0.15]
    return MotionEstimate(
        clock_offset_s=0.0,
        clock_offset_sd_s=0.0,
        start_s=3.0,
        end_s=5.0,
        curve=MotionCurve(
            times_s=times,
            scores=ramp,
            smoothed=ramp,
            threshold=0.1,
            distances_m=ramp,
            speeds_m_s=ramp,
            gripper=ramp,
        ),
        contacts=(ContactPatch(finger="left", point=point, normal=(1, 0, 0), spread_m=0.01, gap_m=0.0),),
        grasp_ee=np.zeros(3),
        joint=joint,
        axis_sd_rad=0.01,
        origin_sd_m=0.01,
        axis_ci95_rad=0.1,
        origin_ci95_m=0.02,
        type_margin=10.0,
        ee_turn_ratio=1.0,
        times_s=times,
        thetas=1.2 * ramp,
        theta_sd=np.zeros(len(times)),
        slip_m=np.zeros(len(times)),
        pivot_rad=np.zeros(len(times)),
        direction="opening",
        part_odds=9.0,
    )


def episode_twin(toy_scene):
    static, moving = toy_scene.surfels
    return with_object(
        toy_scene.twin, static, moving, toy_scene.asset.joint, toy_scene.light, toy_scene.twin.T_world_object
    )


def write_replacement(toy_scene, home: Path, cameras) -> None:
    plane = SupportPlane(height=0.0, low_xy=np.array([-0.2, -0.9]), high_xy=np.array([1.2, 0.8]))
    scene = EpisodeScene(
        support=plane,
        obstacles=(),
        T_world_plane=np.eye(4),
        light=toy_scene.light,
        light_source="made up",
        cameras=cameras,
    )
    save_artifact(home, "scene", scene)
    save_artifact(home / "assets" / "00", "twin", episode_twin(toy_scene))
    fitted = FittedAsset(
        asset=toy_scene.asset,
        T_world_asset=toy_scene.twin.T_world_object,
        contact_asset=toy_scene.asset.handle_point,
        shares=[0.0, 1.0],
        thetas=[0.0, 1.2],
        scale=1.0,
        mirrored=False,
        mode="object",
        residual_mm=0.0,
    )
    save_artifact(home / "assets" / "00", FITTED, fitted)


def write_episode(toy_scene, homes, cameras) -> None:
    """Commit episode 7, of whose frames the third has a contact."""
    robot, T = toy_scene.robot, toy_scene.twin.T_world_object
    joints = toy_scene.twin.scan_state.joints + np.linspace(0, 0.3, FRAMES)[:, None]
    poses, thetas = robot.ee_poses(joints), np.linspace(0, 1.2, FRAMES)
    variation = Variation(seed=0, index=7, x=0.0, y=0.0, yaw=0.0)
    episode = Episode(
        index=7,
        seed=0,
        instruction="open the microwave",
        robot=robot.name,
        asset=toy_scene.asset.name,
        asset_usd="asset.usda",
        joint_names=robot.joint_names,
        fps=5,
        times_s=np.arange(FRAMES) / 5,
        joints=joints,
        gripper=np.zeros(FRAMES),
        action_joints=joints,
        action_gripper=np.zeros(FRAMES),
        Ts_world_ee=poses,
        Ts_world_ee_action=poses,
        thetas=thetas,
        phases=np.zeros(FRAMES, np.int64),
        contacts=ContactLog(
            frames=np.array([2]),
            fingers=np.array([0]),
            points_world=T[None, :3, 3],
            normals_world=np.array([[0.0, 0, 1]]),
            forces=np.array([10.0]),
        ),
        joint=toy_scene.asset.joint.move(T),
        keypoints=apply(T, find_keypoints(toy_scene.asset)),
        T_world_object=T,
        visible={name: np.ones((FRAMES, 5), bool) for name in cameras},
        cameras=cameras,
        verdict={"passed": True, "bolted": True, "variation": asdict(variation)},
        simulation={},
    )
    twin = episode_twin(toy_scene)
    drawn = render_episode(twin, robot, episode, static_layers(twin, cameras), np.eye(4))
    videos = {name: encode_video(item.images_srgb, 5) for name, item in drawn.items()}
    commit_episode(homes["episodes"], episode, videos)
