"""The bundled demonstration, whole and as a short, small one, and a few images of the bundled scan with known cameras."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.io.images import resize
from aomgen.io.video import encode_video, read_video
from foreign_recordings import Demonstration
from foreign_scans import KnownScan, known_scan

# The rate of the bundled video, and the frames in which its gripper closes and the arm moves.
RATE_HZ, FRAMES = 10, slice(38, 62)


@pytest.fixture(scope="session")
def whole(sample: Path) -> Demonstration:
    """The bundled demonstration with its state at the rate of the video."""
    video = read_video(sample / "demo" / "front.mp4")
    log = read_capture(sample).joint_log
    times_s = np.arange(len(video.times_s)) / RATE_HZ
    joints, gripper = log.at(log.times_s[0] + 0.5 + times_s)
    return Demonstration(times_s, joints, gripper, video.frames_srgb, sample / "demo" / "front.mp4")


@pytest.fixture(scope="session")
def short(whole: Demonstration, tmp_path_factory: pytest.TempPathFactory) -> Demonstration:
    """Two seconds of it in a video of 320 x 240 pixels."""
    path = tmp_path_factory.mktemp("short") / "front.mp4"
    path.write_bytes(
        encode_video((resize(frame, 320, 240) for frame in whole.frames[FRAMES]), RATE_HZ, crf=10)
    )
    frames = read_video(path).frames_srgb
    times_s = whole.times_s[: len(frames)]
    return Demonstration(times_s, whole.joints[FRAMES], whole.gripper[FRAMES], frames, path)


@pytest.fixture(scope="session")
def few(sample: Path) -> KnownScan:
    """Twelve images of 640 x 480."""
    return known_scan(sorted((sample / "scan").glob("*.jpg"))[:12], width=640, height=480)
