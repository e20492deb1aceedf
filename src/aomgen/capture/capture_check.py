"""Checks that need every file decoded or the robot loaded."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aomgen.capture.demo_videos import check_demo_video, read_demo_videos
from aomgen.capture.joint_log import check_log
from aomgen.capture.label_images import check_masks, read_demo_masks
from aomgen.capture.prompts import prompt_warnings
from aomgen.capture.scan_images import check_scan
from aomgen.capture.scan_poses import SCAN_POSES_FILE
from aomgen.core.recording import CAPTURE_FILE, Recording
from aomgen.core.values import Array
from aomgen.errors import UnitsError
from aomgen.io.video import Video, probe_video
from aomgen.robots.description import FILE_NAME, find_description
from aomgen.robots.loading import choose_robot
from aomgen.robots.robot import RobotModel

# A real joint may stand this far past the limit that its file states, [rad] or [m].
LIMIT_SLACK = 0.05
# A joint beyond its limits by this much has another zero in the log, or its angles wrap, [rad] or [m].
IMPOSSIBLE = 0.3


def check_capture(capture: Recording) -> tuple[RobotModel, str, tuple[str, ...]]:
    """Check everything that can be known of a capture before work starts.

    Returns:
        The robot; lines about robot, scan, videos and log; and sentences about doubtful properties, their consequences and
        remedies.

    Raises:
        ConfigError, InputError: The first problem that would stop a run, in one sentence.
    """
    videos = read_demo_videos(capture)
    lengths = {name: float(video.times_s[-1] - video.times_s[0]) for name, video in videos.items()}
    warnings = check_log(capture.joint_log, capture.joint_log_file, lengths, capture.clock_offset_s)
    for camera in capture.cameras:
        video = videos[camera.name]
        check_demo_video(video, camera.video)
        count, height, width = video.frames_srgb.shape[:3]
        read_demo_masks(capture, camera, (count, height, width))
        warnings += _shown_otherwise(camera.video)
    count, doubts = check_scan(capture)
    if capture.scan_video is not None:
        doubts += _shown_otherwise(capture.scan_video)
    robot = check_robot(capture)
    doubts += _log_beyond_limits(capture, robot) + list(capture.notes)
    doubts += (
        _list_strange_poses(capture)
        + _guess_robot(capture)
        + check_masks(capture)
        + prompt_warnings(capture.prompts)
    )
    return robot, _describe(capture, robot, count, videos), (*doubts, *warnings)


def _describe(capture: Recording, robot: RobotModel, scan_count: int, videos: Mapping[str, Video]) -> str:
    """Return lines about robot, scan, videos and log, and how the gripper's column is read, so that a wrong unit is noticed."""
    fingers = "two fingers" if robot.pads else "no fingers: it can be followed, but not verified"
    scan = f"video of {scan_count} frames" if capture.scan_video else f"{scan_count} images"
    log = capture.joint_log
    low, high = float(log.gripper.min()), float(log.gripper.max())
    distances = 1000 * robot.pad_distances([low, high])
    apart = f", fingers {distances[0]:.0f} to {distances[1]:.0f} mm apart" if len(distances) else ""
    lines = [
        f"robot  {robot.name}, {len(robot.joint_names)} joints, {fingers}",
        f"scan   {scan}, {capture.scan_size[0]} x {capture.scan_size[1]}{_describe_poses(capture)}",
        *(
            f"video  {name}: {len(video.times_s)} frames, {video.times_s[-1] - video.times_s[0]:.1f} s"
            for name, video in videos.items()
        ),
        f"log    {len(log.times_s)} rows, {log.times_s[-1] - log.times_s[0]:.1f} s, {len(log.joint_names)} joints",
        f"grip   {low:.2f} to {high:.2f} (0 open, 1 closed){apart}",
    ]
    return "\n".join(f"  {line}" for line in lines)


def _guess_robot(capture: Recording) -> list[str]:
    """Warn where no robot.toml describes the capture's robot."""
    file = capture.robot.model_file
    if file is None or find_description(file) is not None:
        return []
    joints = " ".join(f"--joint {name}" for name in capture.robot.joints)
    return [
        f"{file}: has no {FILE_NAME} in its folder, so its gripper and end effector are guessed; "
        f"write the guess down with `aomgen robot propose {file} {joints}` and check it"
    ]


def _describe_poses(capture: Recording) -> str:
    poses = capture.scan_poses
    if poses is None:
        return ""
    known = len(poses.Ts_scan_cam.keys() & {path.name for path in capture.scan_images})
    return f", {known} with a pose" + (" in meters" if poses.metric else "")


def _list_strange_poses(capture: Recording) -> list[str]:
    """Warn about poses of images that the scan does not contain."""
    poses = capture.scan_poses.Ts_scan_cam if capture.scan_poses else {}
    strange = sorted(poses.keys() - {path.name for path in capture.scan_images})
    if not strange:
        return []
    where = capture.scan_images[0].parent / SCAN_POSES_FILE
    return [f"{where}: has poses of {len(strange)} images that are not in the scan ({strange[0]})"]


def check_robot(capture: Recording) -> RobotModel:
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
            capture.folder / CAPTURE_FILE,
            f"'{robot.joint_names[worst]}' is at {capture.robot.scan_joints[worst]:.2f}, but {robot.name} "
            f"allows {low[worst]:.2f} to {high[worst]:.2f}",
            "check the order of robot.joints, and the log's units and zero",
        )
    beyond = _beyond_limits(capture, robot)
    worst = int(np.argmax(beyond))
    if not beyond[worst] <= IMPOSSIBLE:
        reached = capture.joint_log.joints[:, worst]
        raise UnitsError(
            capture.joint_log_file,
            f"'{robot.joint_names[worst]}' reaches {reached.min():.2f} .. {reached.max():.2f}, but {robot.name} "
            f"allows {low[worst]:.2f} to {high[worst]:.2f}: another zero, or an angle that wraps?",
            "check the order of robot.joints, and the log's units and zero",
        )
    return robot


def _beyond_limits(capture: Recording, robot: RobotModel) -> Array:
    """Compute the distances (J,) by which the joints of the log exceed their limits, [rad] or [m]; negative within them."""
    low, high = robot.joint_limits.T
    joints = capture.joint_log.joints
    return np.maximum(low - joints.min(0), joints.max(0) - high)


def _log_beyond_limits(capture: Recording, robot: RobotModel) -> list[str]:
    beyond = _beyond_limits(capture, robot)
    return [
        f"{capture.joint_log_file}: '{name}' passes the limits of {robot.name} by {passed:.2f}"
        for name, passed in zip(robot.joint_names, beyond.tolist(), strict=True)
        if passed > LIMIT_SLACK
    ]


def _shown_otherwise(path: Path) -> list[str]:
    info = probe_video(path)
    done = info.display.describe()
    if not done:
        return []
    return [
        f"{path}: frames are {done}, as players show them: prompts and intrinsics must be those of the "
        f"{info.width} x {info.height} image"
    ]
