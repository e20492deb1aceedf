"""The clock offset, from painted discs and from the rendered robot."""

import numpy as np
import pytest

from aomgen.alignment.time_offset import estimate_clock
from aomgen.core.camera import Camera, look_at
from aomgen.core.recording import JointLog
from aomgen.errors import SyncError
from aomgen.io.video import Video
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import MasksAt, robot_masks

FPS, COUNT = 10.0, 80
TIMES = np.arange(COUNT) / FPS
LOG_TIMES = np.arange(0, 10.0, 0.01)


def path(times_s: np.ndarray) -> np.ndarray:
    """Path (T, 2) of a disc as shares of the image: rests, two strokes of different speed, rests."""
    x = np.interp(times_s, [1.5, 3.0, 4.0, 7.0], [0.15, 0.75, 0.75, 0.3])
    return np.stack([x, 0.3 + 0.4 * np.interp(times_s, [2.0, 6.5], [0, 1])], 1)


def disc(way) -> MasksAt:
    def masks_at(times_s: np.ndarray, width: int, height: int) -> np.ndarray:
        rows, columns = np.mgrid[:height, :width] + 0.5
        centers = way(np.asarray(times_s)) * [width, height]
        return np.stack([np.hypot(columns - x, rows - y) < 0.12 * width for x, y in centers])

    return masks_at


def film(masks: np.ndarray, seed: int = 0) -> Video:
    rng = np.random.default_rng(seed)
    table = rng.integers(60, 200, (*masks.shape[1:], 3))
    frames = np.where(masks[..., None], 20, table[None]) + rng.normal(size=(*masks.shape, 3)) * 3
    return Video(times_s=TIMES, frames_srgb=np.clip(frames, 0, 255).astype(np.uint8), fps=FPS)


@pytest.mark.parametrize("offset", [1.313, -0.2])
def test_the_offset_of_a_painted_film_is_found_to_a_fraction_of_a_frame(offset: float) -> None:
    masks_at = disc(path)
    video = film(masks_at(TIMES + offset, 160, 120))
    estimate = estimate_clock(video, LOG_TIMES, masks_at)
    assert estimate.offset_s == pytest.approx(offset, abs=0.01)
    assert 0 < estimate.sd_s < 0.05


def test_a_slightly_wrong_camera_costs_little() -> None:
    def seen(times_s: np.ndarray) -> np.ndarray:
        return path(times_s) * 1.02 + [0.012, -0.01]

    video = film(disc(seen)(TIMES + 0.74, 160, 120))
    assert estimate_clock(video, LOG_TIMES, disc(path)).offset_s == pytest.approx(0.74, abs=0.03)


def test_a_periodic_motion_is_ambiguous() -> None:
    def swing(times_s: np.ndarray) -> np.ndarray:
        return np.stack([0.5 + 0.2 * np.sin(2 * np.pi * times_s / 2.0), np.full(len(times_s), 0.5)], 1)

    video = film(disc(swing)(TIMES + 0.5, 160, 120))
    with pytest.raises(SyncError):
        estimate_clock(video, LOG_TIMES, disc(swing))


def test_a_resting_arm_tells_nothing() -> None:
    def rest(times_s: np.ndarray) -> np.ndarray:
        return np.full((len(times_s), 2), 0.5)

    video = film(disc(rest)(TIMES, 160, 120))
    with pytest.raises(SyncError):
        estimate_clock(video, LOG_TIMES, disc(path))


def test_a_log_that_is_too_short_is_refused() -> None:
    video = film(disc(path)(TIMES, 160, 120))
    with pytest.raises(SyncError, match="too short"):
        estimate_clock(video, np.arange(0, 0.5, 0.01), disc(path))


def test_the_rendered_robot_gives_the_offset(robot: RobotModel) -> None:
    times = np.arange(0, 6.5, 0.02)
    phase = np.interp(times, [1.0, 3.5, 4.2, 5.5], [0, 1, 1, 0.4])[:, None]
    joints = np.array([3.4, -2.2, 2.4, 0.25, 1.35, 0.0]) + phase * np.array([0.9, 0.5, -0.6, -0.5, 0.8, 0.0])
    log = JointLog(times_s=times, joints=joints, gripper=np.zeros(len(times)), joint_names=robot.joint_names)
    camera = Camera(
        fx=150,
        fy=150,
        cx=80,
        cy=60,
        width=160,
        height=120,
        T_world_cam=look_at([1.2, -1.3, 0.9], [0.1, 0, 0.3]),
    )
    frames = np.arange(50) / FPS
    rng = np.random.default_rng(1)
    table = rng.integers(60, 200, (120, 160, 3))
    with robot_masks(robot, camera, log) as masks_at:
        masks = masks_at(frames + 0.87, 160, 120)
        noisy = np.where(masks[..., None], 30, table) + rng.normal(size=(*masks.shape, 3)) * 3
        video = Video(times_s=frames, frames_srgb=np.clip(noisy, 0, 255).astype(np.uint8), fps=FPS)
        estimate = estimate_clock(video, log.times_s, masks_at)
    assert estimate.offset_s == pytest.approx(0.87, abs=0.02)


def test_a_small_video_is_not_enlarged() -> None:
    """A renderer of the size of the video cannot render larger masks."""
    widths: list[int] = []

    def masks_at(times_s: np.ndarray, width: int, height: int) -> np.ndarray:
        widths.append(width)
        return disc(path)(times_s, width, height)

    video = film(disc(path)(TIMES + 0.74, 96, 72))
    assert estimate_clock(video, LOG_TIMES, masks_at).offset_s == pytest.approx(0.74, abs=0.02)
    assert set(widths) == {96}
