"""Verified episodes rendered and committed, each as one folder. [paper 5.2]"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera, CameraPath
from aomgen.core.episode import Episode
from aomgen.core.plan import EpisodePlan, VerifiedEpisode
from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.episodes.render import CameraFrames, ImageParams, Trajectory, render_episode, static_layers
from aomgen.io.artifact import load_artifact
from aomgen.io.atomic import remove_staging
from aomgen.io.episode_folder import ImageKind, commit_episode, episode_folder, list_committed
from aomgen.io.video import encode_video
from aomgen.results import ASSET_USD, Results
from aomgen.robots.robot import RobotModel
from aomgen.simulation.verify import assumptions
from aomgen.twin.plane_shadow import cast_soft_shadow
from aomgen.twin.twin import Twin
from aomgen.twin.variation import changed, light_gains, scaled

# Episodes rendered at a time, each on one thread; usual machines have more cores.
WORKERS: Final = 2


def run(
    results: Results, folder: Path, progress: Progress, verified: Sequence[VerifiedEpisode]
) -> dict[str, Any]:
    """Every verified plan drawn from all cameras and committed."""
    names = [fitted.asset.name for fitted in results.fitted_assets]
    homes = {name: results.asset_folder(index) for index, name in enumerate(names)}
    folders = run_episodes(
        verified,
        {name: load_artifact(home, "twin", Twin) for name, home in homes.items()},
        {name: home / ASSET_USD for name, home in homes.items()},
        results.robot,
        results.episode_scene.cameras,
        folder,
        instruction=results.recorded.instruction,
        joint_zeros_rad=results.alignment.joint_zeros_rad,
        T_world_plane=results.episode_scene.T_world_plane,
        progress=progress,
    )
    return {"episodes": len(folders), "cameras": ", ".join(results.episode_scene.cameras)}


def run_episodes(
    verified: Sequence[VerifiedEpisode],
    twins: Mapping[str, Twin],
    usd_files: Mapping[str, Path],
    robot: RobotModel,
    cameras: Mapping[str, Camera],
    folder: Path,
    *,
    instruction: str,
    joint_zeros_rad: Array,
    T_world_plane: Array | None = None,
    images: ImageParams = ImageParams(),
    workers: int = WORKERS,
    progress: Progress = silent,
) -> list[Path]:
    """Draw and commit every verified episode that is not committed yet; the folders of all, in order.

    The number of workers changes nothing in the results.

    Args:
        verified: What passed; an episode's folder is its place in this sequence.
        twins: For each asset's name, the cleared scene with that asset in it.
        usd_files: For each asset's name, its USD file, in which others can simulate it.
        folder: Of all episodes; committed ones are kept.
        instruction: Language instruction.
        joint_zeros_rad: Of the recorded arm, see `assumptions`.
        T_world_plane: The surface that shadows fall on, (4, 4).
        images: What is stored of images.
        workers: Episodes drawn at the same time.

    Raises:
        StorageError: The disk refuses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    remove_staging(folder)
    done = set(list_committed(folder))
    open_ = [i for i in range(len(verified)) if episode_folder(folder, i) not in done]
    layers = {name: static_layers(twin, cameras) for name, twin in twins.items()} if open_ else {}
    softs = {
        name: cast_soft_shadow(twin, T_world_plane)
        for name, twin in twins.items()
        if open_ and T_world_plane is not None
    }
    # One engine thread a worker, except when a worker is alone.
    threads = 1 if workers > 1 else None

    def draw(index: int) -> None:
        name = verified[index].plan.fitted.asset.name
        usd = Path(os.path.relpath(usd_files[name], episode_folder(folder, index)))
        paths = {}
        if images.robot_cameras:
            paths = robot.camera_paths(verified[index].joints, verified[index].gripper)
        episode = episode_of(verified[index], index, usd, robot, instruction, cameras, joint_zeros_rad, paths)
        variation = verified[index].plan.variation
        twin = changed(scaled(twins[name], variation.scale), variation.light, variation.material)
        same = (light_gains(variation.light) == 1).all()
        soft = softs.get(name)
        drawn = render_episode(
            twin,
            robot,
            trajectory_of(episode),
            layers[name] if same else static_layers(twin, cameras, threads),
            T_world_plane,
            threads,
            soft=soft and soft.scaled(variation.scale, twin.joint.type == "prismatic"),
            paths=paths,
            params=images,
        )
        store_episode(folder, episode, drawn, images)

    with ThreadPoolExecutor(workers) as pool:
        tasks = [pool.submit(draw, index) for index in open_]
        try:
            for count, task in enumerate(as_completed(tasks), start=len(verified) - len(open_) + 1):
                task.result()
                progress(count / len(verified), f"{count} of {len(verified)} episodes")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [episode_folder(folder, index) for index in range(len(verified))]


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
    """The episode that a verified plan becomes; its actions are the plan one frame ahead."""
    plan = verified.plan
    paths = paths or {}
    moving = {name: path.at(0) for name, path in paths.items()}
    asset = plan.fitted.asset
    return Episode(
        index=index,
        seed=plan.variation.seed,
        instruction=instruction,
        robot=robot.name,
        asset=asset.name,
        asset_usd=usd.as_posix(),
        joint_names=robot.joint_names,
        fps=round(plan.fps),
        joints=verified.joints,
        gripper=verified.gripper,
        action_joints=_ahead(plan.joints),
        action_gripper=_ahead(plan.gripper),
        Ts_world_ee=verified.Ts_world_ee,
        Ts_world_ee_action=_ahead(plan.Ts_world_ee),
        thetas=verified.thetas,
        phases=plan.phases,
        contacts=verified.contacts,
        joint=asset.joint.moved(plan.T_world_object),
        T_world_object=plan.T_world_object,
        cameras={**cameras, **moving},
        camera_poses={name: path.Ts_world_cam for name, path in paths.items()},
        verdict={**verified.verdict.as_json(), "variation": asdict(plan.variation), "grasp": plan.grasp},
        simulation=assumptions(asset, joint_zeros_rad, bolted=verified.verdict.bolted),
    )


def _ahead(samples: Array) -> Array:
    """What comes one sample later (T, ...); the last stays."""
    return np.concatenate([samples[1:], samples[-1:]])


def trajectory_of(episode: Episode | EpisodePlan) -> Trajectory:
    """What moves in the images of an episode, or of a plan."""
    return Trajectory(
        joints=episode.joints,
        gripper=episode.gripper,
        thetas=episode.thetas,
        T_world_object=episode.T_world_object,
    )


def store_episode(
    folder: Path, episode: Episode, drawn: Mapping[str, CameraFrames], params: ImageParams
) -> Path:
    """Encode an episode's images and commit it; raises as `commit_episode`."""
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
