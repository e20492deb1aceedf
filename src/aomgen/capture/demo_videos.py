"""The demonstration's videos: decoded, and refused where they are short, frozen or from a camera that was pushed."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.read import check_intrinsics
from aomgen.core.lens import undistorter
from aomgen.core.recording import CAPTURE_FILE, DemoCamera, Recording
from aomgen.core.values import Array
from aomgen.errors import IncompleteCaptureError, LimitExceededError
from aomgen.io.images import resize
from aomgen.io.video import Video, probe_video, read_video

# A demonstration shorter than this shows no motion that could be fitted.
MIN_FRAMES = 20
# A moving arm changes more of the image at some moment; a frozen camera nothing at all.
MIN_CHANGED_SHARE = 0.003
# Sensor noise and compression of small images stay below this, [grey levels].
CHANGED = 25
# Frames that are compared, and their size [px]: enough to see an arm move in a quarter of a second.
CHANGE_FRAMES = 40
CHANGE_SIZE = (160, 120)  # a gripper is still some ten pixels wide
# Frames compared with the first one in the search for a push, and the width they are reduced to, [px].
FRAMES, WIDTH = 16, 320
# A shift up to this, in reduced pixels, is rounding; it is 0.3 % of the width.
STILL_PX = 1


def read_demo_videos(capture: Recording) -> dict[str, Video]:
    """Decode the video of every demonstration camera and check it against log and intrinsics.

    Returns:
        Video by camera name.

    Raises:
        InputError: Missing, damaged or truncated video; intrinsics of another size; a video that
            is too short or longer than the joint log.
    """
    return {camera.name: _read(capture, camera) for camera in capture.cameras}


def _read(capture: Recording, camera: DemoCamera) -> Video:
    _check_memory(camera.video)
    video = read_video(camera.video)
    count, height, width = video.frames_srgb.shape[:3]
    if camera.intrinsics:
        where = f"{capture.folder / CAPTURE_FILE}: demo.cameras.{camera.name}.intrinsics"
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
    if camera.lens is None:
        return video
    undistort = undistorter(camera.lens)
    frames = np.stack([undistort(frame) for frame in video.frames_srgb])
    return Video(times_s=video.times_s, frames_srgb=frames, fps=video.fps)


def _check_memory(path: Path) -> None:
    """Refuse a video whose frames, held as a list and then as one array, are more than the machine has."""
    info = probe_video(path)
    needed = 2 * 3 * info.width * info.height * info.frames
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if not needed <= memory:
        raise LimitExceededError(
            path,
            f"needs {needed / 1e9:.0f} GB of memory when decoded ({info.frames} frames of {info.width} x "
            f"{info.height}), "
            f"this machine has {memory / 1e9:.0f} GB",
            "cut it, or export it with a smaller size or frame rate",
        )


def check_demo_video(video: Video, path: Path) -> None:
    """Refuse a video in which nothing moves, or everything does because its camera was pushed.

    Raises:
        IncompleteCaptureError: One of these.
    """
    stride = max(1, len(video.times_s) // CHANGE_FRAMES)
    frames = [resize(frame, *CHANGE_SIZE).astype(np.int16) for frame in video.frames_srgb[::stride]]
    changed = max(float(np.mean(np.abs(frame - frames[0]).max(2) > CHANGED)) for frame in frames)
    if not changed >= MIN_CHANGED_SHARE:
        raise IncompleteCaptureError(
            path,
            f"shows no motion ({changed:.2%} of the image changes, at least {MIN_CHANGED_SHARE:.1%} are needed)",
            "check that it is the video of the demonstration and that it is not frozen",
        )
    push = find_push(video)
    if push is not None:
        time_s, share = push
        raise IncompleteCaptureError(
            path,
            f"was recorded by a camera that moved: from {time_s:.1f} s on its background is shifted by {share:.1%} of "
            "the width",
            "fix the camera and record again, or keep only the part of the video before or after the motion",
        )


def find_push(video: Video) -> tuple[float, float] | None:
    """Find the first of some frames from which on the background is shifted relative to the first frame.

    Returns:
        Its time, [s], and the shift as a share of the width; None without a shift.

    Not checked: a push that shifts the background by less than 0.3 % of the width, or a background
    without texture.

    Source: Kuglin & Hines, The phase correlation image alignment method, 1975.
    """
    chosen = np.unique(np.linspace(0, len(video.times_s) - 1, FRAMES).astype(int))
    height, width = video.frames_srgb.shape[1:3]
    size = (min(width, WIDTH), round(height * min(1.0, WIDTH / width)))
    grays = [resize(video.frames_srgb[k], *size).astype(np.float64).mean(2) for k in chosen]
    window = np.outer(np.hanning(size[1]), np.hanning(size[0]))
    first, *others = (np.fft.rfft2(window * (gray - gray.mean())) for gray in grays)
    shifts = np.array([_shift_px(first, other, (size[1], size[0])) for other in others])
    moved = shifts > 0
    # Until the end: objects that pass before the camera leave again.
    since = len(moved) - int(np.argmin(moved[::-1])) if not moved.all() else 0
    if since == len(moved):
        return None
    return float(video.times_s[chosen[since + 1]]), float(np.median(shifts[since:])) / size[0]


def _shift_px(first: NDArray[np.complex128], other: NDArray[np.complex128], size: tuple[int, int]) -> float:
    """Estimate the shift of another frame's background from the first one's, [px]; 0 if it did not move."""
    product = first.conj() * other
    surface: Array = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-9), size)
    rows, columns = np.fft.fftfreq(size[0], 1 / size[0]), np.fft.fftfreq(size[1], 1 / size[1])
    # A recording is not continued after a push by more than a tenth of the image.
    surface = np.where(
        (np.abs(rows)[:, None] <= size[1] / 10) & (np.abs(columns) <= size[1] / 10), surface, -1
    )
    still = (np.abs(rows)[:, None] <= STILL_PX) & (np.abs(columns) <= STILL_PX)
    row, column = np.unravel_index(int(np.argmax(np.where(still, -np.inf, surface))), size)
    # Over the correlation where it was: 0.2 to 0.5 with a moving arm, 1.3 to 12 after a push by 0.6 % of the width.
    if surface[row, column] <= surface[still].max():
        return 0.0
    return float(np.hypot(rows[row], columns[column]))
