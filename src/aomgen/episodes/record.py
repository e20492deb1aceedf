"""Record of a verified plan, and its commit with images."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera, CameraPath
from aomgen.core.episode import Episode
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import VerifiedEpisode
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.render import CameraFrames, ImageParams
from aomgen.io.episode_folder import ImageKind, commit_episode
from aomgen.io.video import encode_video
from aomgen.robots.robot import RobotModel
from aomgen.simulation.verify import assumptions


def episode_of(
    verified: VerifiedEpisode,
    index: int,
    usd: Path,
    robot: RobotModel,
    instruction: str,
    cameras: Mapping[str, Camera],
    joint_zeros_rad: Array,
    paths: Mapping[str, CameraPath] | None = None,
) -> Episode:
    """Build the episode of a verified plan; actions are the plan one frame ahead.

    `paths` are those of moving cameras.
    """
    plan, reached, paths = verified.plan, verified.reached, paths or {}
    moving = {name: path.at(0) for name, path in paths.items()}
    asset = plan.fitted.asset
    settings = tuple(outcome.setting for outcome in verified.verdict.outcomes)
    return Episode(
        index=index,
        seed=plan.variation.seed,
        instruction=instruction,
        robot=robot.name,
        asset=asset.name,
        asset_usd=usd.as_posix(),
        joint_names=robot.joint_names,
        fps=round(plan.fps),
        times_s=reached.times_s,
        joints=reached.joints,
        gripper=reached.gripper,
        thetas=reached.thetas,
        action_joints=_ahead(plan.joints),
        action_gripper=_ahead(plan.gripper),
        Ts_world_ee=reached.ee_poses(robot),
        Ts_world_ee_action=_ahead(plan.Ts_world_ee),
        phases=plan.phases,
        contacts=verified.contacts,
        joint=asset.joint.move(plan.T_world_object),
        keypoints=apply(plan.T_world_object, find_keypoints(asset)),
        T_world_object=plan.T_world_object,
        cameras={**cameras, **moving},
        camera_poses={name: path.Ts_world_cam for name, path in paths.items()},
        verdict={**verified.verdict.as_json(), "variation": asdict(plan.variation), "grasp": plan.grasp},
        simulation=assumptions(asset, settings, joint_zeros_rad, bolted=verified.verdict.bolted),
    )


def _ahead(samples: Array) -> Array:
    """Shift samples (T, ...) by one; the last is repeated."""
    return np.concatenate([samples[1:], samples[-1:]])


def store_episode(
    folder: Path, episode: Episode, drawn: Mapping[str, CameraFrames], params: ImageParams
) -> Path:
    """Encode an episode's images and commit it with the keypoints that they show; raises as `commit_episode`."""
    episode = replace(episode, visible={name: np.asarray(frames.visible) for name, frames in drawn.items()})
    videos = {
        name: encode_video(frames.images_srgb, episode.fps, codec=params.codec)
        for name, frames in drawn.items()
    }
    images: dict[ImageKind, dict[str, NDArray]] = {}
    if params.depth:
        images["depth"] = {name: np.asarray(frames.depth_mm) for name, frames in drawn.items()}
    if params.labels:
        images["labels"] = {name: np.asarray(frames.labels) for name, frames in drawn.items()}
    return commit_episode(folder, episode, videos, images, params.codec)
