"""Checks that need the videos decoded or the robot loaded."""

import numpy as np

from aomgen.capture.read import check_intrinsics
from aomgen.core.lens import Lens
from aomgen.core.recording import Capture
from aomgen.errors import IncompleteCaptureError, UnitsError
from aomgen.io.straighten import straightener
from aomgen.io.video import Video, decoded_frames, read_video
from aomgen.physics.robot import RobotModel, chosen_robot

MIN_FRAMES = 20
# A real joint may stand this far past the limit that its file states, [rad] or [m].
LIMIT_SLACK = 0.05


def check_robot(capture: Capture) -> RobotModel:
    """Load the capture's robot and check that it is the log's.

    Raises:
        ConfigError, InputError: The robot cannot be used, or a joint stays outside its limits
            during the scan.
    """
    robot = chosen_robot(capture.robot)
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


def check_scan_video(capture: Capture) -> int:
    """Decode a scan video from end to end; the number of its frames, 0 when the scan is stills.

    Raises:
        InputError: Missing, damaged or truncated video.
    """
    return 0 if capture.scan_video is None else sum(1 for _ in decoded_frames(capture.scan_video))


def _checked(capture: Capture, index: int) -> Video:
    camera = capture.cameras[index]
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
    return video if camera.lens is None else _straightened(video, camera.lens)


def _straightened(video: Video, lens: Lens) -> Video:
    straighten = straightener(lens)
    frames = np.stack([straighten(frame) for frame in video.frames_srgb])
    return Video(times_s=video.times_s, frames_srgb=frames, fps=video.fps)
