"""Checks that need every file decoded or the robot loaded."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aomgen.capture.demo_masks import read_demo_masks
from aomgen.capture.log_check import check_log
from aomgen.capture.mask_check import check_masks
from aomgen.capture.prompts import prompt_warnings
from aomgen.capture.read import check_intrinsics
from aomgen.capture.scan_check import check_scan
from aomgen.capture.steadiness import find_push
from aomgen.core.lens import Lens, undistorter
from aomgen.core.recording import Capture
from aomgen.errors import IncompleteCaptureError, LimitExceededError, UnitsError
from aomgen.io.images import resize
from aomgen.io.video import Video, decode_frames, probe_video, read_video
from aomgen.robots.description import FILE_NAME, find_description
from aomgen.robots.loading import choose_robot
from aomgen.robots.robot import RobotModel

# A demonstration shorter than this shows no motion that could be fitted.
MIN_FRAMES = 20
# A real joint may stand this far past the limit that its file states, [rad] or [m].
LIMIT_SLACK = 0.05
# A moving arm changes more of the image at some moment; a frozen camera nothing at all.
MIN_CHANGED_SHARE = 0.003
# Sensor noise and compression of small images stay below this, [grey levels].
CHANGED = 25
# Frames that are compared, and their size [px]: enough to see an arm move in a quarter of a second.
CHANGE_FRAMES = 40
CHANGE_SIZE = (160, 120)  # a gripper is still some ten pixels wide


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckedCapture:
    """What the check of a capture found.

    Attributes:
        robot: Of the capture.
        scan_count: Stills, or frames of the scan video.
        videos_s: Length of every demonstration video by camera, [s].
        frames: Their numbers of frames.
        warnings: Sentences: what is doubtful, and what follows or what to do.
    """

    robot: RobotModel
    scan_count: int
    videos_s: dict[str, float]
    frames: dict[str, int]
    warnings: tuple[str, ...]

    def summary(self, capture: Capture) -> str:
        """Lines about robot, scan, videos and log."""
        fingers = "two fingers" if self.robot.pads else "no fingers: it can be followed, but not verified"
        scan = f"video of {self.scan_count} frames" if capture.scan_video else f"{self.scan_count} images"
        log = capture.joint_log
        lines = [
            f"robot  {self.robot.name}, {len(self.robot.joint_names)} joints, {fingers}",
            f"scan   {scan}, {capture.scan_size[0]} x {capture.scan_size[1]}",
            *(
                f"video  {name}: {self.frames[name]} frames, {length:.1f} s"
                for name, length in self.videos_s.items()
            ),
            f"log    {len(log.times_s)} rows, {log.times_s[-1] - log.times_s[0]:.1f} s, "
            f"{len(log.joint_names)} joints",
        ]
        return "\n".join(f"  {line}" for line in lines)


def check_capture(capture: Capture) -> CheckedCapture:
    """Check everything that can be known of a capture before work starts.

    Raises:
        ConfigError, InputError: The first thing that would stop a run, in one sentence.
    """
    videos = read_demo_videos(capture)
    lengths = {name: float(video.times_s[-1] - video.times_s[0]) for name, video in videos.items()}
    warnings = check_log(capture.joint_log, capture.joint_log_file, lengths, capture.clock_offset_s)
    for camera in capture.cameras:
        video = videos[camera.name]
        _check_motion(video, camera.video)
        _check_steady(video, camera.video)
        count, height, width = video.frames_srgb.shape[:3]
        read_demo_masks(capture, camera, (count, height, width))
        warnings += _turned(camera.video)
    count, doubts = check_scan(capture)
    if capture.scan_video is not None:
        doubts += _turned(capture.scan_video)
    return CheckedCapture(
        robot=check_robot(capture),
        scan_count=count,
        videos_s=lengths,
        frames={name: len(video.times_s) for name, video in videos.items()},
        warnings=(
            *doubts,
            *guessed_robot(capture),
            *check_masks(capture),
            *prompt_warnings(capture.prompts),
            *warnings,
        ),
    )


def guessed_robot(capture: Capture) -> list[str]:
    """A warning where no robot.toml says what the parts of the capture's robot are for."""
    file = capture.robot.model_file
    if file is None or find_description(file) is not None:
        return []
    joints = " ".join(f"--joint {name}" for name in capture.robot.joints)
    return [
        f"{file}: has no {FILE_NAME} beside it, so its gripper and end effector are guessed; "
        f"write the guess down with `aomgen robot propose {file} {joints}` and check it"
    ]


def check_robot(capture: Capture) -> RobotModel:
    """Load the capture's robot and check that it is the log's.

    Raises:
        ConfigError, InputError: The robot cannot be used, or a joint stays outside its limits
            during the scan.
    """
    robot = choose_robot(capture.robot)
    low, high = robot.joint_limits.T
    outside = np.maximum(low - capture.robot.scan_joints, capture.robot.scan_joints - high)
    worst = int(np.argmax(outside))
    if not outside[worst] <= LIMIT_SLACK:
        raise UnitsError(
            capture.folder / "capture.toml",
            f"'{robot.joint_names[worst]}' stands at {capture.robot.scan_joints[worst]:.2f}, but {robot.name} "
            f"allows {low[worst]:.2f} to {high[worst]:.2f}",
            "check the order of robot.joints, and the log's units and zero",
        )
    return robot


def read_demo_videos(capture: Capture) -> dict[str, Video]:
    """Decode the video of every demonstration camera and check it against log and intrinsics.

    Returns:
        Video by camera name.

    Raises:
        InputError: Missing, damaged or truncated video; intrinsics of another size; a video that
            is too short or longer than the joint log.
    """
    return {camera.name: _checked(capture, index) for index, camera in enumerate(capture.cameras)}


def _checked(capture: Capture, index: int) -> Video:
    camera = capture.cameras[index]
    _check_memory(camera.video)
    video = read_video(camera.video)
    count, height, width = video.frames_srgb.shape[:3]
    if camera.intrinsics:
        where = f"{capture.folder / 'capture.toml'}: demo.cameras.{camera.name}.intrinsics"
        check_intrinsics(camera.intrinsics, (width, height), where)
    if not count >= MIN_FRAMES:
        raise IncompleteCaptureError(
            camera.video,
            f"has {count} frames, at least {MIN_FRAMES} are needed",
            "record the whole demonstration",
        )
    length_s = video.times_s[-1] - video.times_s[0]
    log_s = capture.joint_log.times_s[-1] - capture.joint_log.times_s[0]
    if not log_s >= 0.95 * length_s:
        raise IncompleteCaptureError(
            camera.video,
            f"lasts {length_s:.1f} s, but the joint log only {log_s:.1f} s",
            "re-export the log over the whole demonstration",
        )
    return video if camera.lens is None else _undistorted(video, camera.lens)


def _check_memory(path: Path) -> None:
    """Refuse a video whose frames, held as a list and then as one array, are more than the machine has."""
    info = probe_video(path)
    needed = 2 * 3 * info.width * info.height * info.frames
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if not needed <= memory:
        raise LimitExceededError(
            path,
            f"takes {needed / 1e9:.0f} GB decoded ({info.frames} frames of {info.width} x {info.height}), "
            f"this machine has {memory / 1e9:.0f} GB",
            "cut it, or export it smaller or with fewer frames a second",
        )


def _check_motion(video: Video, path: Path) -> None:
    stride = max(1, len(video.times_s) // CHANGE_FRAMES)
    frames = [resize(frame, *CHANGE_SIZE).astype(np.int16) for frame in video.frames_srgb[::stride]]
    changed = max(float(np.mean(np.abs(frame - frames[0]).max(2) > CHANGED)) for frame in frames)
    if not changed >= MIN_CHANGED_SHARE:
        raise IncompleteCaptureError(
            path,
            f"shows nothing that moves ({changed:.2%} of the picture changes, want {MIN_CHANGED_SHARE:.1%})",
            "check that it is the demonstration's video and that the camera did not freeze",
        )


def _check_steady(video: Video, path: Path) -> None:
    push = find_push(video)
    if push is not None:
        raise IncompleteCaptureError(
            path,
            f"was moved: from {push.time_s:.1f} s on its background lies {push.share:.1%} of the width from where "
            "it was at the start",
            "fix the camera and record again, or cut the video with its part before or after the push",
        )


def _turned(path: Path) -> list[str]:
    _, frame = next(decode_frames(path))
    if not frame.rotation:
        return []
    return [
        f"{path}: players turn it by {frame.rotation} degrees; here it stays as stored, {frame.width} x "
        f"{frame.height}: prompts and intrinsics must be those of that picture"
    ]


def _undistorted(video: Video, lens: Lens) -> Video:
    undistort = undistorter(lens)
    frames = np.stack([undistort(frame) for frame in video.frames_srgb])
    return Video(times_s=video.times_s, frames_srgb=frames, fps=video.fps)
