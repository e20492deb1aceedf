"""Reading the joint log, refusing what cannot be one, and comparing it with the videos it should belong to."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.capture.log_clock import MAX_SPEED_RAD_S, TICKS, TIME_COLUMN, order_rows, read_times
from aomgen.capture.log_table import LogTable, read_log_table, read_number
from aomgen.core.recording import JointLog
from aomgen.core.values import Array
from aomgen.errors import (
    IncompleteCaptureError,
    NonFiniteError,
    UnitsError,
)

# Between rows the arm is interpolated; further apart than this it may have stopped and turned back, [s]. Two
# rows that a log of 15 Hz lost are bridged.
MAX_STEP_S = 0.25
# A gap this long hides part of a motion; shorter ones are the jitter of a driver, [s].
WIDE_STEP_S = 0.1
# No joint of a table-top arm passes these; logs in degrees do at once.
MAX_ANGLE_RAD = 2 * np.pi * 1.02
# A step between two rows that is this near to whole turns is a wrapped angle, [rad]. The fastest wrist turns by
# less between two rows of a log of 15 Hz.
MAX_WRAP_ERROR = 0.5
# Rate that docs/capture.md requests, with room for 29.97 Hz, [1/s].
WANTED_RATE_HZ = 29.0
# Opening anything by 5 cm turns some joint of a table-top arm by more, [rad] or [m].
MIN_TRAVEL = 0.03
# While the arm rests its encoders show 0.003 rad of noise over the first tenth of a second.
REST_S = 0.1
# More than that noise, less than any motion, [rad].
MAX_REST_TRAVEL = 0.02
# Fewer rows show no motion.
MIN_ROWS = 10
# The gripper is open or closed beyond these.
OPEN, CLOSED = 0.3, 0.7
# A gripper that opens by less keeps its hold, as a share of its stroke.
MIN_OPENING = 0.15
# Encoder noise of a gripper that stands still, as a share of its stroke.
GRIPPER_NOISE = 0.02
# A gripper's stated open and closed values may be exceeded by this share of the stroke.
STROKE_SLACK = 0.05
# The widest two-finger grippers open by 0.14 m; a column that moves but stays below this is likely their
# opening in metres, [m].
MAX_OPENING_M = 0.15
# Units of other drivers: largest value of the column, the probable unit, and what to write.
GRIPPER_UNITS: Final = (
    (102.0, "percent or millimeters", "[0, 100] for percent, [85, 0] for an opening of 85 mm"),
    (255.0, "counts of 0..255", "[0, 255]"),
    (np.inf, "another unit", "[0, 1000] for example"),
)


def read_joint_log(
    path: Path, joint_names: Sequence[str], gripper: str, gripper_range: Sequence[float] = ()
) -> tuple[JointLog, tuple[str, ...]]:
    """Read times, joints and gripper from a table; see `log_table` for its dialects, `log_clock` for its times.

    Args:
        joint_names: Columns of the J joints, [rad] or [m].
        gripper: Column of the gripper.
        gripper_range: Values of that column with the gripper open and closed, where it is not 0 .. 1.

    Returns:
        The log, and sentences about everything that was skipped, sorted, merged or unwrapped.

    Raises:
        MalformedFileError: Missing column, wrong number of fields, not a number, times that step back.
        NonFiniteError: NaN or infinite value; names row and column.
        IncompleteCaptureError: Fewer than 10 rows.
        UnitsError: Angles or speeds that only degrees have; a gripper in another unit than 0..1 or its range.
    """
    table = read_log_table(path, [*joint_names, gripper])
    if not len(table.rows) >= MIN_ROWS:
        raise IncompleteCaptureError(
            path, f"has {len(table.rows)} rows, at least {MIN_ROWS} are needed", "re-export the log"
        )
    times, clock_notes = read_times(table, [*joint_names, gripper])
    joints = np.array([_finite_column(table, name) for name in joint_names]).T
    grip = _read_gripper(path, gripper, _finite_column(table, gripper), gripper_range)
    times, values, rows, order_notes = order_rows(table, times, np.column_stack([joints, grip]))
    _check_angles(path, values[:, :-1], joint_names)
    joints, wrap_notes = unwrap(values[:, :-1], joint_names)
    _check_speeds(path, times, joints, [table.lines[row] for row in rows], joint_names)
    notes = (*table.notes, *clock_notes, *order_notes, *wrap_notes)
    return (
        JointLog(times_s=times, joints=joints, gripper=values[:, -1], joint_names=tuple(joint_names)),
        tuple(f"{path}: {note}" for note in notes),
    )


def _finite_column(table: LogTable, name: str) -> Array:
    values = np.array(table.column(name, read_number))
    if not np.isfinite(values).all():
        row = table.lines[int(np.argmin(np.isfinite(values)))]
        raise NonFiniteError(
            table.path, f"row {row}, column '{name}' is not finite", "re-export the log or drop the row"
        )
    return values


def unwrap(joints: Array, joint_names: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """Remove jumps of whole turns between two rows; drivers that wrap angles to -180 .. 180 degrees cause them.

    A joint that was unwrapped is moved by whole turns so that the middle of its range is nearest to 0.

    Args:
        joints: (T, J), [rad] or [m]; metres never step by 6.28.

    Returns:
        Joints (T, J), and one sentence for each that wrapped.
    """
    turn = 2 * np.pi
    steps = np.diff(joints, axis=0)
    turns = np.round(steps / turn)
    turns[np.abs(steps - turn * turns) > MAX_WRAP_ERROR] = 0.0
    counts = np.count_nonzero(turns, axis=0)
    wrapped = counts > 0
    unwrapped = joints.copy()
    unwrapped[1:] -= turn * np.cumsum(turns, axis=0)
    middle = (unwrapped.min(0) + unwrapped.max(0)) / 2
    unwrapped -= turn * np.where(wrapped, np.round(middle / turn), 0.0)
    notes = tuple(
        f"'{name}' wraps by a whole turn at {count} rows and was unwrapped to {low:.2f} .. {high:.2f} rad"
        for name, count, low, high in zip(
            joint_names, counts.tolist(), unwrapped.min(0).tolist(), unwrapped.max(0).tolist(), strict=True
        )
        if count
    )
    return unwrapped, notes


def _read_gripper(path: Path, name: str, values: Array, stated: Sequence[float]) -> Array:
    """Convert the gripper's values to (T,), 0 open .. 1 closed.

    Raises:
        UnitsError: Values outside the stated range, or without one, outside 0..1 or so small that they are
            likely metres.
    """
    low, high = float(values.min()), float(values.max())
    spans = f"'{name}' spans {low:.4g} to {high:.4g}"
    if stated:
        opened, closed = stated
        share = (values - opened) / (closed - opened)
        if not (share.min() >= -STROKE_SLACK and share.max() <= 1 + STROKE_SLACK):
            raise UnitsError(
                path, f"{spans}, outside robot.gripper_range = [{opened:g}, {closed:g}]",
                "give the column's values with the gripper open and closed",
            )  # fmt: skip
        return np.clip(share, 0.0, 1.0)
    if not (low >= -STROKE_SLACK and high <= 1 + STROKE_SLACK):
        unit, example = next((unit, example) for limit, unit, example in GRIPPER_UNITS if high <= limit)
        raise UnitsError(
            path, f"{spans}, expected 0 (open) to 1 (closed); is the unit {unit}?",
            f"state the values of open and closed: robot.gripper_range = {example}",
        )  # fmt: skip
    if high <= MAX_OPENING_M and high - low >= GRIPPER_NOISE / 2:
        raise UnitsError(
            path, f"{spans}, so with 0 (open) .. 1 (closed) it never closes; is the unit meters?",
            "state the values of open and closed: robot.gripper_range = [0.085, 0] for an opening of 85 mm, "
            "[0, 1] if it does stay open",
        )  # fmt: skip
    return np.clip(values, 0.0, 1.0)


def _check_angles(path: Path, joints: Array, joint_names: Sequence[str]) -> None:
    largest = np.abs(joints).max(0)
    worst = int(np.argmax(largest))
    if not largest[worst] <= MAX_ANGLE_RAD:
        raise UnitsError(
            path,
            f"'{joint_names[worst]}' reaches {largest[worst]:.1f}, limit {MAX_ANGLE_RAD:.2f} rad; is the unit degrees?",
            "convert the log to radians",
        )


def _check_speeds(
    path: Path, times: Array, joints: Array, rows: Sequence[int], joint_names: Sequence[str]
) -> None:
    # Speeds over 0.1 s, so that encoder noise at a high rate does not count as motion.
    stride = max(1, round(0.1 / float(np.median(np.diff(times)))))
    if len(times) > stride:
        speeds = np.abs(joints[stride:] - joints[:-stride]) / (times[stride:] - times[:-stride])[:, None]
        row, column = divmod(int(np.argmax(speeds)), speeds.shape[1])
        if not speeds[row, column] <= MAX_SPEED_RAD_S:
            raise UnitsError(
                path,
                f"'{joint_names[column]}' moves at {speeds[row, column]:.1f} per second at row {rows[row]}, "
                f"limit {MAX_SPEED_RAD_S} rad/s: degrees?",
                "convert the log to radians",
            )


def check_log(log: JointLog, path: Path, videos_s: dict[str, float], offset_s: float | None) -> list[str]:
    """Check a log against the lengths of its videos; warnings.

    Args:
        videos_s: Length of every video by the name of its camera, [s]; each begins at its own zero.
        offset_s: Known clock offset of the first video (log time = video time + offset), [s]; None if it is unknown.

    Raises:
        UnitsError: Times that only milliseconds, microseconds or nanoseconds explain.
        IncompleteCaptureError: Rows too far apart, a known offset that leads out of the log, or no
            joint that moves.
    """
    _check_steps(log, path, max(videos_s.values()))
    first, last = log.times_s[0], log.times_s[-1]
    name, video_s = next(iter(videos_s.items()))
    if offset_s is not None and not (
        offset_s >= first - 0.05 * video_s and offset_s + video_s <= last + 0.05 * video_s
    ):
        raise IncompleteCaptureError(
            path,
            f"with clock_offset_s = {offset_s:g} the video of '{name}' lasts from {offset_s:.1f} s to "
            f"{offset_s + video_s:.1f} s, the log from {first:.1f} s to {last:.1f} s",
            "correct it (log time = video time + offset), or leave it out to estimate it",
        )
    travel = np.ptp(log.joints, axis=0)
    if not travel.max() >= MIN_TRAVEL:
        raise IncompleteCaptureError(
            path,
            f"has no joint that moves (at most {travel.max():.4f} rad, at least {MIN_TRAVEL:g} rad are needed)",
            "export the log of the demonstration with measured joint positions",
        )
    return _warnings(log, path)


def _check_steps(log: JointLog, path: Path, video_s: float) -> None:
    steps = np.diff(log.times_s)
    worst = int(np.argmax(steps))
    # Times are written with rounded decimals.
    if steps[worst] <= MAX_STEP_S + 1e-3:
        return
    length = log.times_s[-1] - log.times_s[0]
    for unit, ticks in TICKS.items():
        if ticks > 1 and 0.95 * video_s <= length / ticks and np.median(steps) / ticks <= MAX_STEP_S:
            raise UnitsError(
                path,
                f"{TIME_COLUMN} spans {length:.0f} s, the video {video_s:.1f} s; is the unit {unit}?",
                f"divide time_s by {ticks:.0f}",
            )
    raise IncompleteCaptureError(
        path,
        f"has no joint rows between {log.times_s[worst]:.2f} s and {log.times_s[worst + 1]:.2f} s, "
        f"{steps[worst]:.2f} s apart, limit {MAX_STEP_S} s",
        "log at 30 Hz or more; re-export the log or cut the demonstration",
    )


def _warnings(log: JointLog, path: Path) -> list[str]:
    found = []
    rate = 1 / float(np.median(np.diff(log.times_s)))
    if rate < WANTED_RATE_HZ:
        found.append(
            f"has {rate:.0f} rows per second, 30 or more are recommended: clock offset, contact and joint values "
            "become less accurate"
        )
    travel = float(np.ptp(log.joints[log.times_s <= log.times_s[0] + REST_S], axis=0).max())
    if travel > MAX_REST_TRAVEL:
        found.append(
            f"the arm moves by {travel:.2f} rad in the first {REST_S} s: start the log while it is at rest in the "
            "configuration of the scan, or state robot.scan_state"
        )
    wide = np.diff(log.times_s) > WIDE_STEP_S
    if rate >= WANTED_RATE_HZ and wide.any():
        found.append(
            f"has {int(wide.sum())} gaps of more than {WIDE_STEP_S} s (longest {np.diff(log.times_s).max():.2f} s), "
            "in which joint values are interpolated"
        )
    # A gripper closes to grasp; if it is closed at the start and opens, its values are probably reversed.
    grip = log.gripper
    if grip[0] >= CLOSED and grip[0] - grip.min() >= MIN_OPENING:
        found.append(
            "the gripper is closed at the start and then opens (0 is open, 1 closed); if its values are reversed, "
            "state robot.gripper_range = [1, 0]"
        )
    return [f"{path}: {warning}" for warning in found]
