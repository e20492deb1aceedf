"""Results of a run by stage; each value is read once, on first use."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from aomgen.capture.demo_videos import read_demo_videos
from aomgen.capture.read import read_capture
from aomgen.core.alignment import Alignment, FixedCamera
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.demonstration import Demonstration, EpisodeScene
from aomgen.core.gaussians import Gaussians
from aomgen.core.motion import MotionEstimate
from aomgen.core.parts import Parts
from aomgen.core.plan import FittedAsset
from aomgen.core.project import Project
from aomgen.core.recording import JointLog, Recording
from aomgen.core.structure import Structure
from aomgen.io.artifact import load_artifact
from aomgen.io.ply import read_gaussians
from aomgen.io.schema import override
from aomgen.io.video import Video, probe_video
from aomgen.robots.loading import choose_robot
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.twin.twin import TwinModel, TwinState

# Stages store their values by `save_artifact(folder, <name of the stage>, value)` and in the following files.
GAUSSIANS_FILE = "gaussians.ply"
T = TypeVar("T")
ASSETS_FOLDER, FITTED, ASSET_USD = "assets", "fitted", "asset.usda"
# Folder of the twin without its object.
BACKGROUND_FOLDER = "background"


@dataclass(frozen=True)
class Results:
    """Inputs and results of a run.

    Access to a value raises `MissingFileError` if the stage that computes it has not finished.

    Attributes:
        project: Settings of the run.
        out: Folder of the run.
        folders: Final folder of every stage, by stage name.
        workers: Number of processes that generate episodes.
        ray: Address of the Ray cluster that generates them instead; empty for none.
        store: URL of the store through which its workers get inputs and return episodes; empty if they can access the
            folders of the run.
    """

    project: Project
    out: Path
    folders: Mapping[str, Path]
    workers: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    ray: str = ""
    store: str = ""

    def params(self, stage: str, defaults: T) -> T:
        """Return the parameters of a stage: its defaults with the changes of the project.

        Raises:
            ConfigError: The project sets an unknown parameter, or a value of the wrong type.
        """
        return override(defaults, self.project.params.get(stage, {}), stage)

    # Values of the capture:

    @cached_property
    def recorded(self) -> Recording:
        """The capture as it was recorded."""
        return read_capture(self.project.capture)

    @cached_property
    def recorded_videos(self) -> dict[str, Video]:
        """Decoded videos of the fixed cameras, as recorded."""
        return read_demo_videos(self.recorded)

    @cached_property
    def robot(self) -> RobotModel:
        """Robot of the capture, in the capture's world frame."""
        return choose_robot(self.recorded.robot)

    @property
    def demo_camera(self) -> str:
        """Name of the fixed camera whose video shows the motion: the first one."""
        return self.recorded.cameras[0].name

    # Values after the stage structure:

    @cached_property
    def structure(self) -> Structure:
        """Cameras and sparse points, recon frame."""
        return load_artifact(self.folders["structure"], "structure", Structure)

    @cached_property
    def pinhole_capture(self) -> Recording:
        """The capture with undistorted images and videos; a capture of pinhole cameras is not changed."""
        found, folder = self.structure, self.folders["structure"]
        cameras = tuple(
            replace(camera, lens=found.demo_lenses.get(camera.name)) for camera in self.recorded.cameras
        )
        capture = replace(self.recorded, cameras=cameras)
        if found.pinhole is None:
            return capture
        scan, masks = found.pinhole, capture.mask_folders
        if scan.masks is not None:
            masks = {name: folder / file for name, file in scan.masks.items()}
        images = tuple(folder / file for file in scan.images)
        return replace(capture, scan_images=images, prompts=scan.prompts, mask_folders=masks)

    @cached_property
    def scan_images(self) -> dict[str, Path]:
        """Undistorted images of the scan by name."""
        return {path.name: path for path in self.pinhole_capture.scan_images}

    @cached_property
    def videos(self) -> dict[str, Video]:
        """Decoded videos of the fixed cameras, undistorted."""
        bent = any(camera.lens for camera in self.pinhole_capture.cameras)
        return read_demo_videos(self.pinhole_capture) if bent else self.recorded_videos

    # Values after the stage gaussians:

    @cached_property
    def gaussians_recon(self) -> Gaussians:
        """The trained Gaussians, recon frame."""
        return read_gaussians(self.folders["gaussians"] / GAUSSIANS_FILE)

    # Values after the stage alignment:

    @cached_property
    def alignment(self) -> Alignment:
        """Similarity from reconstruction to world, joint zeros, and fixed cameras."""
        return load_artifact(self.folders["alignment"], "alignment", Alignment)

    @cached_property
    def capture(self) -> Recording:
        """The undistorted capture with calibrated joint zeros, which later stages use."""
        capture, zeros_rad = self.pinhole_capture, self.alignment.joint_zeros_rad
        log, robot = capture.joint_log, capture.robot
        return replace(
            capture,
            joint_log=replace(log, joints=log.joints + zeros_rad),
            robot=replace(robot, scan_joints=robot.scan_joints + zeros_rad),
        )

    def configuration_in(self, capture: Recording) -> RobotConfiguration:
        """Return the configuration of the robot during the scan of a capture."""
        return RobotConfiguration(
            robot=self.robot, joints=capture.robot.scan_joints, gripper=capture.robot.scan_gripper
        )

    @cached_property
    def configuration(self) -> RobotConfiguration:
        """Configuration of the robot during the scan."""
        return self.configuration_in(self.capture)

    @property
    def fixed_camera(self) -> FixedCamera:
        """The first fixed camera with its calibration."""
        return self.alignment.cameras[self.demo_camera]

    @cached_property
    def demo_log(self) -> JointLog:
        """The robot's joint log on the clock of the first fixed camera's video.

        Raises:
            SyncError: The clock offset is unknown.
        """
        return self.capture.joint_log.shift(self.fixed_camera.require_clock().offset_s)

    @cached_property
    def scan_cameras(self) -> dict[str, Camera]:
        """Registered scan cameras by image name, world frame."""
        cameras = self.structure.cameras_recon
        return {name: camera_in_world(self.alignment.S_world_recon, item) for name, item in cameras.items()}

    @cached_property
    def gaussians(self) -> Gaussians:
        """The trained Gaussians, world frame."""
        return self.gaussians_recon.transform(self.alignment.S_world_recon)

    # Values after the stage parts:

    @cached_property
    def parts(self) -> Parts:
        """Part labels of `scene`."""
        return load_artifact(self.folders["parts"], "parts", Parts)

    @cached_property
    def scene(self) -> Gaussians:
        """The trained Gaussians after the stage parts has split some of them, world frame."""
        return self.parts.cut.apply(self.gaussians)

    # Values after the stage motion:

    @cached_property
    def motion(self) -> MotionEstimate:
        """Start, end, contact, joint and joint values of the demonstration."""
        return load_artifact(self.folders["motion"], "motion", MotionEstimate)

    @cached_property
    def fps(self) -> float:
        """Frame rate of the first fixed camera's video, [1/s], rounded; episodes have the same rate."""
        return float(round(probe_video(self.recorded.cameras[0].video).fps))

    @cached_property
    def demonstration(self) -> Demonstration:
        """Motion of robot and part from the first to the last video frame, sampled at the video's rate."""
        return resample_demonstration(self.motion, self.demo_log, self.robot, self.fps)

    def states_at(self, times_s: ArrayLike, T_world_object: ArrayLike) -> tuple[TwinState, ...]:
        """Interpolate the states of robot and part at video times (N,), [s], for an object at a pose (4, 4)."""
        times = np.asarray(times_s, np.float64)
        joints, gripper = self.demo_log.at(times)
        pose = np.asarray(T_world_object, np.float64)
        return tuple(
            TwinState(joints=q, gripper=float(g), theta=float(theta), T_world_object=pose)
            for q, g, theta in zip(joints, gripper, self.motion.theta_at(times), strict=True)
        )

    # Values after the stages twin and replacement:

    @cached_property
    def twin(self) -> TwinModel:
        """Twin of the recorded scene."""
        return load_artifact(self.folders["twin"], "twin", TwinModel)

    @cached_property
    def episode_scene(self) -> EpisodeScene:
        """Table, light and cameras of new episodes."""
        return load_artifact(self.folders["replacement"], "scene", EpisodeScene)

    def asset_folder(self, index: int) -> Path:
        """Return the folder that holds the fit, the USD file and the twin of a fitted asset."""
        return self.folders["replacement"] / ASSETS_FOLDER / f"{index:02d}"

    @cached_property
    def fitted_assets(self) -> list[FittedAsset]:
        """Assets that could be fitted, in the order of the project."""
        count = len(list((self.folders["replacement"] / ASSETS_FOLDER).glob("*")))
        return [load_artifact(self.asset_folder(index), FITTED, FittedAsset) for index in range(count)]


def resample_demonstration(
    motion: MotionEstimate, log: JointLog, robot: RobotModel, fps: float
) -> Demonstration:
    """Sample the recorded demonstration at a constant rate.

    Args:
        motion: Estimated motion, at the times of the video.
        log: Joint log on the clock of that video; it is averaged over half a sample period to reduce noise.
        robot: Robot of the log.
        fps: Samples per second.

    Returns:
        Samples from the first to the last video frame.
    """
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    times = first + np.arange(int((last - first) * fps + 1e-6) + 1) / fps
    # The mean of five values within half a sample period around each sample reduces the noise of the log.
    offsets = np.linspace(-0.25, 0.25, 5) / fps
    readings = [log.at(times + offset) for offset in offsets]
    joints = np.mean([joints for joints, _ in readings], 0)
    gripper = np.clip(np.mean([gripper for _, gripper in readings], 0), 0.0, 1.0)
    return Demonstration(
        times_s=times,
        joints=joints,
        gripper=gripper,
        Ts_world_ee=robot.ee_poses(joints),
        thetas=motion.theta_at(times),
        start_s=motion.start_s,
        end_s=motion.end_s,
        joint=motion.joint,
        grasp_ee=motion.grasp_ee,
        ee_turn_ratio=motion.ee_turn_ratio,
    )
