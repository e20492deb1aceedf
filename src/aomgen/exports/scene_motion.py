"""Motion of a twin, the recorded demonstration or one episode, with all data that export formats use."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera, CameraPath
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.episode import ContactLog
from aomgen.core.gaussians import Gaussians
from aomgen.core.lens import Lens
from aomgen.core.plan import FittedAsset
from aomgen.core.values import Array
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import MAX_DRAWS
from aomgen.episodes.variations import scale_fit
from aomgen.errors import MissingFileError, UnknownNameError
from aomgen.io.episode_folder import (
    CommittedEpisode,
    episode_folder,
    list_committed,
    read_episode,
    read_variation,
)
from aomgen.io.undistorted_video import decode_undistorted
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel, pose_bodies, trajectory_body_poses
from aomgen.twin.variation import change_appearance, scale_object


@dataclass(frozen=True, kw_only=True)
class SceneMotion:
    """A twin and the motion of its robot and object, T frames.

    Attributes:
        name: "demonstration" or the number of the episode.
        twin: Twin with the moving object.
        robot: Robot of the twin.
        trajectory: Reached joints, gripper and joint values of the object.
        commands: Commanded joints and gripper (T + 1, J + 1) at the start of each frame and the end of the last one.
        cameras: Fixed cameras of the motion, world frame, by name.
        paths: Moving cameras, by name.
        videos: Recorded or rendered videos by camera name.
        video_starts_s: Time of the first frame of a video on the trajectory's clock, by name, [s].
        lenses: Lenses of the videos with distorted images, by camera name.
        contacts: Contacts of the fingers; None for a recording.
        fitted: Physical model of the object; None for the recorded object.
    """

    name: str
    twin: TwinModel
    robot: RobotModel
    trajectory: SceneTrajectory
    commands: Array
    cameras: Mapping[str, Camera]
    paths: Mapping[str, CameraPath] = field(default_factory=dict)
    videos: Mapping[str, Path] = field(default_factory=dict)
    video_starts_s: Mapping[str, float] = field(default_factory=dict)
    lenses: Mapping[str, Lens] = field(default_factory=dict)
    contacts: ContactLog | None = None
    fitted: FittedAsset | None = None

    @property
    def fps(self) -> float:
        """Return the frame rate, [1/s]."""
        times = self.trajectory.times_s
        return round((len(times) - 1) / float(times[-1] - times[0]), 6)

    @cached_property
    def Ts_world_body(self) -> Array:
        """Return the poses (T, B, 4, 4) of the twin's bodies."""
        moved = self.trajectory
        return trajectory_body_poses(
            self.twin, self.robot, moved.joints, moved.gripper, moved.thetas, moved.T_world_object
        )

    def decode_video(self, name: str) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """Yield the time in the video, [s], and the undistorted image (H, W, 3) of each frame of a camera's video.

        Raises:
            MissingFileError, MalformedFileError, LimitExceededError: See `io.undistorted_video.decode_undistorted`.
        """
        return decode_undistorted(self.videos[name], self.lenses.get(name))

    def body_gaussians(self) -> dict[str, Gaussians]:
        """Return the Gaussians of each body that has any, in the frame of the body, lit as in the first frame."""
        world = pose_bodies(self.twin, self.Ts_world_body[0])
        lit = self.twin.gaussians
        if self.twin.relit is not None:
            sh = np.array(lit.sh)
            sh[self.twin.relit.indices, 0] = world.sh[self.twin.relit.indices, 0]
            lit = lit.with_sh(sh)
        numbers = np.unique(self.twin.bodies)
        return {self.twin.body_names[n]: lit.select(self.twin.bodies == n) for n in numbers}


def open_motion(results: Results, episode: int | None) -> SceneMotion:
    """Read an episode by its number, or the recorded demonstration.

    Raises:
        MissingFileError, UnknownNameError: The run has no episodes, or none with this number.
    """
    if episode is None:
        return _open_demonstration(results)
    committed = _read_committed(results, episode)
    made, variation = committed.episode, read_variation(committed)
    opened = EpisodeFactory(results, results.folders["episodes"]).asset(made.index // MAX_DRAWS)
    twin = scale_object(opened.twin, variation.scale)
    states = np.column_stack([made.joints, made.gripper])
    actions = np.column_stack([made.action_joints, made.action_gripper])
    return SceneMotion(
        name=str(made.index),
        twin=change_appearance(twin, variation.light, variation.material),
        robot=results.robot,
        trajectory=made,
        # Action t is the target of frame t + 1.
        commands=np.concatenate([states[:1], actions]),
        cameras={name: view for name, view in made.cameras.items() if name not in made.camera_poses},
        paths={
            name: CameraPath(camera=made.cameras[name], Ts_world_cam=Ts)
            for name, Ts in made.camera_poses.items()
        },
        videos=committed.videos,
        video_starts_s=dict.fromkeys(committed.videos, 0.0),
        contacts=made.contacts,
        fitted=scale_fit(opened.fitted, variation.scale),
    )


def first_episode(results: Results) -> int:
    """Return the number of the first committed episode.

    Raises:
        MissingFileError: There is no committed episode.
    """
    folder = results.folders["episodes"]
    found = list_committed(folder)
    if not found:
        raise MissingFileError(
            folder, "holds no committed episode", f"finish stage 'episodes' with `aomgen run {results.out}`"
        )
    return int(found[0].name)


def _open_demonstration(results: Results) -> SceneMotion:
    """Open the recorded motion, without videos of cameras with an unknown clock offset."""
    demo, twin, fixed = results.demonstration, results.twin, results.alignment.cameras
    clocks = {name: camera.clock for name, camera in fixed.items() if camera.clock is not None}
    first = fixed[results.demo_camera].require_clock().offset_s
    recorded = [item for item in results.pinhole_capture.cameras if item.name in clocks]
    states = np.column_stack([demo.joints, demo.gripper])
    return SceneMotion(
        name="demonstration",
        twin=twin,
        robot=results.robot,
        trajectory=demo.with_object(twin.T_world_object),
        commands=np.concatenate([states, states[-1:]]),
        cameras={name: camera.camera for name, camera in fixed.items()},
        videos={item.name: item.video for item in recorded},
        lenses={item.name: item.lens for item in recorded if item.lens},
        video_starts_s={name: clock.offset_s - first for name, clock in clocks.items()},
    )


def _read_committed(results: Results, number: int) -> CommittedEpisode:
    folder = results.folders["episodes"]
    first_episode(results)
    known = [int(found.name) for found in list_committed(folder)]
    if number not in known:
        raise UnknownNameError("--episode", str(number), map(str, known))
    return read_episode(episode_folder(folder, number))
