"""Motions on the timeline of the twin page: the recording, and committed episodes."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.camera import CameraPath
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.lens import Lens
from aomgen.core.values import Array
from aomgen.io.episode_folder import CommittedEpisode
from aomgen.io.images import encode_jpeg
from aomgen.io.undistorted_video import decode_undistorted
from aomgen.results import Results

# Number of videos whose frames are cached as JPEG, so that switching between them is fast.
KEPT_VIDEOS: Final = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownMotion:
    """A motion on the timeline.

    Attributes:
        title: Displayed name.
        times_s: Increasing times (T,), [s].
        trajectory: States at these times; None before the motion is estimated.
        cameras: Cameras of the videos, each with one pose or T poses.
        videos: Functions by camera that return the JPEG of the frame nearest to a time of the motion, [s].
    """

    title: str
    times_s: Array
    trajectory: SceneTrajectory | None
    cameras: Mapping[str, CameraPath]
    videos: Mapping[str, Callable[[float], bytes]]

    def describe(self) -> dict[str, Any]:
        """Return the data of the motion for the page: times, states, cameras and names of the videos."""
        path = self.trajectory
        states = None if path is None else {
            "joints": path.joints.round(5).tolist(),
            "gripper": path.gripper.round(4).tolist(),
            "theta": path.thetas.round(5).tolist(),
        }  # fmt: skip
        cameras = {
            name: {
                "Ts_world_cam": item.Ts_world_cam.reshape(-1, 16).tolist(),
                **{key: getattr(item.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
            }
            for name, item in self.cameras.items()
        }
        videos = list(self.videos)
        return {
            "title": self.title,
            "times": self.times_s.round(4).tolist(),
            "states": states,
            "cameras": cameras,
            "videos": videos,
        }


@lru_cache(KEPT_VIDEOS)
def _read_frames_jpeg(file: Path, lens: Lens | None, changed_ns: int) -> tuple[Array, tuple[bytes, ...]]:
    times, frames = [], []
    for time_s, image in decode_undistorted(file, lens):
        times.append(time_s)
        frames.append(encode_jpeg(image, halve_colors=False))
    return np.array(times), tuple(frames)


def read_frames_jpeg(file: Path, lens: Lens | None) -> tuple[Array, tuple[bytes, ...]]:
    """Return the times (T,) [s] of a video's frames and their JPEG bytes, cached while the video does not change."""
    changed_ns = file.stat().st_mtime_ns if file.is_file() else 0
    return _read_frames_jpeg(file, lens, changed_ns)


def read_frame_jpeg(file: Path, lens: Lens | None, offset_s: float, time_s: float) -> bytes:
    """Return the JPEG of the frame of a video nearest to a time of a motion, [s]; the time in the video is later by `offset_s`.

    Raises:
        InputError: The video is missing or damaged.
    """
    times, frames = read_frames_jpeg(file, lens)
    return frames[int(np.argmin(np.abs(times - (time_s + offset_s))))]


def read_recording(results: Results, done: Collection[str]) -> ShownMotion:
    """Read the recorded demonstration, as far as the stages in `done` have processed it.

    Raises:
        InputError: The capture is missing or damaged.
    """
    cameras, videos = {}, {}
    aligned = "alignment" in done
    lenses = {item.name: item.lens for item in results.recorded.cameras}
    lenses |= results.structure.demo_lenses if "structure" in done else {}
    first = results.alignment.cameras[results.demo_camera].clock if aligned else None
    for item in results.recorded.cameras:
        fixed = results.alignment.cameras.get(item.name) if aligned else None
        clock = fixed.clock if fixed else None
        # Both clock offsets relate a video to the same joint log.
        offset = first.offset_s - clock.offset_s if first and clock else 0.0
        if fixed:
            cameras[item.name] = CameraPath(camera=fixed.camera, Ts_world_cam=fixed.camera.T_world_cam[None])
        videos[item.name] = partial(read_frame_jpeg, item.video, lenses[item.name], offset)
    if "motion" in done:
        times = results.motion.times_s
    else:
        files = {item.name: item.video for item in results.recorded.cameras}
        times, _ = read_frames_jpeg(files[results.demo_camera], lenses[results.demo_camera])
    trajectory = None
    if "twin" in done:
        T_world_object = results.twin.T_world_object
        joints, gripper = results.demo_log.at(times)
        trajectory = SceneTrajectory(
            times_s=times,
            joints=joints,
            gripper=gripper,
            thetas=results.motion.theta_at(times),
            T_world_object=T_world_object,
        )
    return ShownMotion(
        title="recording", times_s=times, trajectory=trajectory, cameras=cameras, videos=videos
    )


def show_episode(committed: CommittedEpisode) -> ShownMotion:
    """Return the motion of a committed episode, or of a sample without an episode, which has no videos."""
    episode = committed.episode
    cameras = {
        name: CameraPath(camera=camera, Ts_world_cam=episode.camera_poses.get(name, camera.T_world_cam[None]))
        for name, camera in episode.cameras.items()
    }
    videos = {name: partial(read_frame_jpeg, file, None, 0.0) for name, file in committed.videos.items()}
    return ShownMotion(
        title=f"{'episode' if videos else 'draw'} {episode.index}: {episode.asset}",
        times_s=episode.times_s,
        trajectory=episode,
        cameras=cameras,
        videos=videos,
    )
