"""Reading the joint log, refusing what cannot be one, and comparing it with the videos it should belong to."""

import csv
from pathlib import Path

import numpy as np

from aomgen.core.recording import JointLog
from aomgen.core.values import Array
from aomgen.errors import (
    IncompleteCaptureError,
    LimitExceededError,
    MalformedFileError,
    NonFiniteError,
    UnitsError,
)

# Half an hour at 1 kHz, far above any demonstration.
MAX_ROWS = 2_000_000
# A gap of up to two missing rows is interpolated; a longer one hides motion.
MAX_GAP_PERIODS = 3.5
# No joint of a table-top arm passes these; logs in degrees do at once.
MAX_ANGLE_RAD = 2 * np.pi * 1.02
# See above; the fastest wrists reach some 6 rad/s.
MAX_SPEED_RAD_S = 12.0
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
# The gripper is open or closed beyond these.
OPEN, CLOSED = 0.3, 0.7


def read_joint_log(path: Path, joint_names: list[str], gripper: str) -> JointLog:
    """Read `time_s,<joints>,<gripper>` rows, columns found by name.

    Raises:
        MalformedFileError: Missing column, wrong number of fields, not a number, times not increasing.
        NonFiniteError: NaN or infinite value; names row and column.
        IncompleteCaptureError: Fewer than 10 rows, or a gap of more than two rows.
        UnitsError: Angles or speeds that only degrees have; a gripper outside 0..1.
    """
    columns = ["time_s", *joint_names, gripper]
    rows = _read_rows(path, columns)
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        row, column = bad[0]
        raise NonFiniteError(
            path,
            f"row {row + 2}, column '{columns[column]}' is not finite",
            "re-export the log or drop the row",
        )
    times, joints, grip = rows[:, 0], rows[:, 1:-1], rows[:, -1]
    _check_times(path, times)
    _check_units(path, times, joints, grip, joint_names, gripper)
    return JointLog(times_s=times, joints=joints, gripper=np.clip(grip, 0, 1), joint_names=tuple(joint_names))


def _read_rows(path: Path, wanted: list[str]) -> Array:
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
            raise MalformedFileError(
                path, "has no commas between its columns", "export it with commas, and with points in numbers"
            )
        missing = [name for name in wanted if name not in header]
        if missing:
            raise MalformedFileError(
                path,
                f"has no column '{missing[0]}' (columns: {', '.join(header) or 'none'})",
                "name it in capture.toml",
            )
        picks = [header.index(name) for name in wanted]
        rows = []
        for number, fields in enumerate(reader, start=2):
            if not fields:
                continue
            if not number <= MAX_ROWS:
                raise LimitExceededError(path, f"has more than {MAX_ROWS} rows")
            try:
                rows.append([float(fields[pick]) for pick in picks])
            except (ValueError, IndexError) as error:
                raise MalformedFileError(
                    path, f"row {number} is not {len(header)} numbers", "re-export the log"
                ) from error
    if not len(rows) >= 10:
        raise IncompleteCaptureError(
            path, f"has {len(rows)} rows, at least 10 are needed", "re-export the log"
        )
    return np.array(rows)


def _check_times(path: Path, times: Array) -> None:
    steps = np.diff(times)
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0))
        raise MalformedFileError(
            path, f"time does not increase at row {row + 3}", "sort the log or re-export it"
        )
    limit = MAX_GAP_PERIODS * float(np.median(steps))
    worst = int(np.argmax(steps))
    if not steps[worst] <= limit:
        raise IncompleteCaptureError(
            path,
            f"has no joint rows between {times[worst]:.2f} s and {times[worst + 1]:.2f} s "
            f"(rows {worst + 2} and {worst + 3}, limit {limit:.2f} s)",
            "re-export the log or cut the demonstration",
        )


def _check_units(
    path: Path, times: Array, joints: Array, grip: Array, joint_names: list[str], gripper: str
) -> None:
    largest = np.abs(joints).max(0)
    worst = int(np.argmax(largest))
    if not largest[worst] <= MAX_ANGLE_RAD:
        raise UnitsError(
            path,
            f"'{joint_names[worst]}' reaches {largest[worst]:.1f}, limit {MAX_ANGLE_RAD:.2f} rad: degrees?",
            "convert the log to radians",
        )
    # Speeds over 0.1 s, so that encoder noise at a high rate does not count as motion.
    stride = max(1, round(0.1 / float(np.median(np.diff(times)))))
    if len(times) > stride:
        speeds = np.abs(joints[stride:] - joints[:-stride]) / (times[stride:] - times[:-stride])[:, None]
        row, column = np.unravel_index(int(np.argmax(speeds)), speeds.shape)
        if not speeds[row, column] <= MAX_SPEED_RAD_S:
            raise UnitsError(
                path,
                f"'{joint_names[column]}' moves at {speeds[row, column]:.1f} per second at row {row + 2}, "
                f"limit {MAX_SPEED_RAD_S} rad/s: degrees?",
                "convert the log to radians",
            )
    if not (grip.min() >= -0.05 and grip.max() <= 1.05):
        raise UnitsError(
            path,
            f"'{gripper}' spans {grip.min():.2f} to {grip.max():.2f}, want 0 (open) to 1 (closed)",
            "divide by the stroke",
        )


def check_log(log: JointLog, path: Path, videos_s: dict[str, float], offset_s: float | None) -> list[str]:
    """Check a log against the lengths of its videos; warnings.

    Args:
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
    return _warnings(log, path)


def _check_steps(log: JointLog, path: Path, video_s: float) -> None:
    steps = np.diff(log.times_s)
    worst = int(np.argmax(steps))
    # Times are written with rounded decimals.
    if steps[worst] <= MAX_STEP_S + 1e-3:
        return
    length = log.times_s[-1] - log.times_s[0]
    for unit, ticks in CLOCKS.items():
        if 0.95 * video_s <= length / ticks and np.median(steps) / ticks <= MAX_STEP_S:
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


def _warnings(log: JointLog, path: Path) -> list[str]:
    found = []
    rate = 1 / float(np.median(np.diff(log.times_s)))
    if rate < WANTED_RATE_HZ:
        found.append(
            f"{rate:.0f} rows a second, want 30 or more: clock offset, contact and joint values become coarser"
        )
    travel = float(np.ptp(log.joints[log.times_s <= log.times_s[0] + REST_S], axis=0).max())
    if travel > MAX_REST_TRAVEL:
        found.append(
            f"the arm moves by {travel:.2f} rad in the first {REST_S} s: start the log while it rests in the "
            "scan's configuration, or give robot.scan_state"
        )
    # A gripper that is closed at both ends and open between them has probably been logged upside down.
    grip = log.gripper
    if grip[0] >= CLOSED and grip[-1] >= CLOSED and grip.min() <= OPEN:
        found.append(
            "the gripper starts and ends closed and opens between: 0 is open and 1 closed, is it reversed?"
        )
    return [f"{path}: {warning}" for warning in found]
