"""Whether a joint log can be the log of its videos."""

from pathlib import Path

import numpy as np

from aomgen.core.recording import JointLog
from aomgen.errors import IncompleteCaptureError, UnitsError

# Between rows the arm is interpolated; further apart than this it may have stopped and turned back, [s]. Two
# rows that a log of 15 Hz lost are bridged.
MAX_STEP_S = 0.25
# What docs/capture.md asks for, with room for 29.97 Hz, [1/s].
WANTED_RATE_HZ = 29.0
# Opening anything by 5 cm turns some joint of a table-top arm by more, [rad] or [m].
MIN_TRAVEL = 0.03
# While the arm rests its encoders show 0.003 rad of noise over the first tenth of a second.
REST_S = 0.1
# More than that noise, less than any motion, [rad].
MAX_REST_TRAVEL = 0.02
# How a log's clock may count, in ticks a second.
CLOCKS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
# A log may run on after its video, but not for longer than this many times.
MAX_LONGER = 100.0
# The gripper is open or closed beyond these.
OPEN, CLOSED = 0.3, 0.7


def check_log(log: JointLog, path: Path, videos_s: dict[str, float], offset_s: float | None) -> list[str]:
    """Check a log against the lengths of its videos; warnings.

    Args:
        log: As read.
        path: Of the log.
        videos_s: Length of every video by the name of its camera, [s]; each begins at its own zero.
        offset_s: Known clock offset (log time = video time + offset), [s].

    Raises:
        UnitsError: Times that only milliseconds, microseconds or nanoseconds explain.
        IncompleteCaptureError: Rows too far apart, a known offset that leads out of the log, or no
            joint that moves.
    """
    _check_steps(log, path, max(videos_s.values()))
    first, last = log.times_s[0], log.times_s[-1]
    for name, video_s in videos_s.items():
        if offset_s is not None and not (
            offset_s >= first - 0.05 * video_s and offset_s + video_s <= last + 0.05 * video_s
        ):
            raise IncompleteCaptureError(
                path,
                f"with clock_offset_s = {offset_s:g} the video of '{name}' lasts from {offset_s:.1f} s to "
                f"{offset_s + video_s:.1f} s, the log from {first:.1f} s to {last:.1f} s",
                "log time = video time + offset; leave it out to have it estimated",
            )
    travel = np.ptp(log.joints, axis=0)
    if not travel.max() >= MIN_TRAVEL:
        raise IncompleteCaptureError(
            path,
            f"has no joint that moves (at most {travel.max():.4f} rad, want {MIN_TRAVEL:g})",
            "export the demonstration's log, joint positions as measured",
        )
    return _rate_warnings(log, path) + _rest_warnings(log, path) + _gripper_warnings(log, path)


def _check_steps(log: JointLog, path: Path, video_s: float) -> None:
    steps = np.diff(log.times_s)
    worst = int(np.argmax(steps))
    # Times are written with rounded decimals.
    if steps[worst] <= MAX_STEP_S + 1e-3:
        return
    length = log.times_s[-1] - log.times_s[0]
    for unit, ticks in CLOCKS.items():
        if (
            0.95 * video_s <= length / ticks <= MAX_LONGER * video_s
            and np.median(steps) / ticks <= MAX_STEP_S
        ):
            raise UnitsError(
                path,
                f"time_s spans {length:.0f} s, the video {video_s:.1f} s: {unit}?",
                f"divide time_s by {ticks:.0f}",
            )
    raise IncompleteCaptureError(
        path,
        f"rows {worst + 2} and {worst + 3} are {steps[worst]:.2f} s apart, limit {MAX_STEP_S} s",
        "log at 30 Hz or more",
    )


def _rate_warnings(log: JointLog, path: Path) -> list[str]:
    rate = 1 / float(np.median(np.diff(log.times_s)))
    if rate >= WANTED_RATE_HZ:
        return []
    return [
        f"{path}: {rate:.0f} rows a second, want 30 or more: clock offset, contact and joint values become coarser"
    ]


def _rest_warnings(log: JointLog, path: Path) -> list[str]:
    start = log.joints[log.times_s <= log.times_s[0] + REST_S]
    travel = float(np.ptp(start, axis=0).max())
    if travel <= MAX_REST_TRAVEL:
        return []
    return [
        f"{path}: the arm moves by {travel:.2f} rad in the first {REST_S} s: start the log while it rests in the "
        "scan's configuration, or give robot.scan_state"
    ]


def _gripper_warnings(log: JointLog, path: Path) -> list[str]:
    """A hand that is closed at both ends and open between them has probably been logged upside down."""
    grip = log.gripper
    if grip[0] >= CLOSED and grip[-1] >= CLOSED and grip.min() <= OPEN:
        return [
            f"{path}: the gripper starts and ends closed and opens between: 0 is open and 1 closed, is it reversed?"
        ]
    return []
