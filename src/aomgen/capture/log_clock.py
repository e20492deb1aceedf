"""The time column of a joint log: its name, its unit, and the order of its rows."""

import re
from collections.abc import Sequence
from datetime import datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.log_table import LogTable, read_number
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError, NonFiniteError

# Name of the column in the capture format.
TIME_COLUMN: Final = "time_s"
# Ticks per second by unit.
TICKS: Final = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_ABBREVIATIONS: Final = {
    "s": "seconds", "sec": "seconds", "secs": "seconds", "second": "seconds", "seconds": "seconds",
    "ms": "milliseconds", "msec": "milliseconds", "msecs": "milliseconds", "milliseconds": "milliseconds",
    "us": "microseconds", "usec": "microseconds", "usecs": "microseconds", "µs": "microseconds",
    "microseconds": "microseconds",
    "ns": "nanoseconds", "nsec": "nanoseconds", "nsecs": "nanoseconds", "nanosec": "nanoseconds",
    "nanoseconds": "nanoseconds",
}  # fmt: skip
# Names of time columns, with an optional unit: `timestamp`, `Time [ms]`, `header.stamp`, `t_ns`, `%time`.
_NAME: Final = re.compile(
    r"%?(?:[a-z]*[._ ])?(?:time|times|timestamp|timestamps|stamp|t|clock)"
    r"(?:[ _.\-]*[\[(]?(" + "|".join(sorted(_ABBREVIATIONS, key=len, reverse=True)) + r")[\])]?)?"
)
# Longest median period of a log, [s]: four rows per second. This number is smaller than the period of a 2 kHz log in milliseconds,
# and likewise for the next units, so the median period determines the unit of a column whose name states none.
LONGEST_PERIOD_S: Final = 0.25
# Largest step back between rows that are only out of order, [s]; a larger one is the start of another recording.
MAX_REORDER_S: Final = 0.25
# Upper limit of the joint speeds of a table-top arm, [rad/s]; the fastest wrists reach about 6 rad/s.
MAX_SPEED_RAD_S: Final = 12.0


def find_time_column(header: Sequence[str]) -> tuple[str, str]:
    """Find the name of the time column and its unit; the unit is "" if the name does not state it.

    The column is `time_s` if it exists, or else the first name that denotes a time; names with a unit have priority.

    Args:
        header: Column names that are not those of joints.

    Returns:
        Column and unit; both empty if there is none.

    Example:
        >>> find_time_column(["force", "Timestamp [ms]"])
        ('Timestamp [ms]', 'milliseconds')
    """
    matches = [(name, _NAME.fullmatch(name.strip().lower())) for name in header]
    named = [(name, _ABBREVIATIONS.get(found[1] or "", "")) for name, found in matches if found]
    # The sort is stable: `time_s` is first, then names with a unit, then the others in the order of the columns.
    named.sort(key=lambda item: (item[0] != TIME_COLUMN, not item[1]))
    return named[0] if named else ("", "")


def read_times(table: LogTable, others: Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """Read the times of a log's rows, [s].

    Args:
        others: Columns that contain other quantities.

    Returns:
        Times (T,) in the order of the file, and notes on the assumptions.

    Raises:
        MalformedFileError: No time column, or a field that is neither a number nor an ISO 8601 date.
        NonFiniteError: A time is not finite.
    """
    header = [column for column in table.header if column not in others]
    name, unit = find_time_column(header)
    if not name:
        raise MalformedFileError(
            table.path,
            f"has no column '{TIME_COLUMN}' (columns: {', '.join(table.header) or 'none'})",
            "name the column of the time stamps time_s",
        )
    at = table.header.index(name)
    dated = bool(table.rows) and len(table.rows[0]) > at and _is_date(table.rows[0][at])
    ticks = np.array(table.column(name, _read_date if dated else read_number))
    if not np.isfinite(ticks).all():
        row = table.lines[int(np.argmin(np.isfinite(ticks)))]
        raise NonFiniteError(table.path, f"row {row}, column '{name}' is not finite", "re-export the log")
    if name == TIME_COLUMN and not dated:
        return ticks, ()
    unit = unit or ("seconds" if dated else _guess_unit(ticks))
    times, source = ticks / TICKS[unit], f"column '{name}'"
    rest = _nanoseconds_beside(name, header) if unit == "seconds" else ""
    if rest:
        times, source = times + np.array(table.column(rest, read_number)) / 1e9, f"{source} with '{rest}'"
    return times, (f"{source} is taken as the time in {unit}",)


def _nanoseconds_beside(name: str, header: Sequence[str]) -> str:
    """Find the column of ROS stamps with the nanoseconds of a column of whole seconds; "" without one."""
    stem = re.sub(r"secs?$", "", name)
    pairs = {f"{stem}nanosec", f"{stem}nsec", f"{stem}nsecs"} if stem != name else set[str]()
    return next((other for other in header if other in pairs), "")


def _is_date(text: str) -> bool:
    try:
        _read_date(text)
    except ValueError:
        return False
    return bool(re.search(r"\d-\d\d-\d\d", text))


def _read_date(text: str) -> float:
    return datetime.fromisoformat(text.strip()).timestamp()


def _guess_unit(ticks: Array) -> str:
    """Find the unit in which the median period is that of a log with at least four rows a second."""
    steps = np.abs(np.diff(ticks))
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return next((unit for unit, scale in TICKS.items() if period / scale <= LONGEST_PERIOD_S), "seconds")


def order_rows(
    table: LogTable, times: Array, values: Array
) -> tuple[Array, Array, NDArray[np.intp], tuple[str, ...]]:
    """Sort rows by time and merge those of one time stamp.

    Args:
        times: (T,), [s].
        values: Joint and gripper values (T, C).

    Returns:
        Times (U,), strictly increasing, values (U, C), the first row (U,) of each, and notes.

    Raises:
        MalformedFileError: Time steps back by more than `MAX_REORDER_S`, or rows with the same time stamp have different
            values.
    """
    back = np.maximum.accumulate(times) - times
    worst = int(np.argmax(back))
    if not back[worst] <= MAX_REORDER_S:
        raise MalformedFileError(
            table.path,
            f"time decreases by {back[worst]:.2f} s at row {table.lines[worst]}",
            "keep the rows of one recording",
        )
    notes = []
    if back[worst] > 0:
        notes.append(f"{int((np.diff(times) < 0).sum())} rows were not in the order of time and were sorted")
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    unique, first, counts = np.unique(times, return_index=True, return_counts=True)
    if len(unique) == len(times):
        return times, values, order, tuple(notes)
    limit = MAX_SPEED_RAD_S * float(np.median(np.diff(unique)))
    spread = np.maximum.reduceat(values, first) - np.minimum.reduceat(values, first)
    row, column = np.unravel_index(int(np.argmax(spread)), spread.shape)
    if not spread[row, column] <= limit:
        number = table.lines[int(order[first[row]])]
        raise MalformedFileError(
            table.path,
            f"has {counts[row]} rows of the time {unique[row]:.3f} s (the first is row {number}) that differ by "
            f"{spread[row, column]:.2f}, limit {limit:.2f}",
            "re-export the log with the time of each row",
        )
    extra = len(times) - len(unique)
    notes.append(f"{extra} row{'s' * (extra > 1)} repeated a time stamp and were merged")
    return unique, np.add.reduceat(values, first) / counts[:, None], order[first], tuple(notes)
