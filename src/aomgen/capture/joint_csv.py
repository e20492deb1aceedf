"""Reading the joint log and refusing what cannot be a joint log."""

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


def read_joint_log(path: Path, joint_names: list[str], gripper: str) -> JointLog:
    """Read `time_s,<joints>,<gripper>` rows, columns found by name.

    Raises:
        MalformedFileError: Missing column, wrong number of fields, not a number, times not increasing.
        NonFiniteError: NaN or infinite value; names row and column.
        IncompleteCaptureError: Fewer than 10 rows, or a gap of more than two rows.
        UnitsError: Angles or speeds that only degrees have; a gripper outside 0..1.
    """
    rows = _read_rows(path, ["time_s", *joint_names, gripper])
    columns = ["time_s", *joint_names, gripper]
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
