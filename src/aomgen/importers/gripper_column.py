"""The column of the gripper, and its conversion to 0 (open) .. 1 (closed)."""

import re
from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from aomgen.capture.joint_log import CLOSED, GRIPPER_NOISE, MAX_OPENING_M, OPEN, STROKE_SLACK
from aomgen.core.values import Array
from aomgen.errors import ConfigError, MalformedFileError, UnitsError, UnknownNameError
from aomgen.importers.recorded import JointTable

# Column names of gripper measurements.
_GRIPPER: Final = re.compile(r"gripper|finger|knuckle|driver_joint", re.IGNORECASE)
# Names of joints whose value is an angle, not 0 .. 1.
_ANGLE: Final = re.compile(r"finger|knuckle|driver", re.IGNORECASE)
# Largest values of percentages and of one-byte counts, with the overshoot of drivers.
MAX_PERCENT, MAX_COUNT = 102.0, 260.0
# For columns that are 0 if the gripper is open: lower and upper bound of the largest value, and the value of the closed
# gripper. Between 1 and 90 the unit may be per cent, counts or millimeters.
_TOPS: Final = (
    (MAX_OPENING_M, 1.0 + STROKE_SLACK, 1.0),
    (90.0, MAX_PERCENT, 100.0),
    (MAX_PERCENT, MAX_COUNT, 255.0),
)
EXAMPLES: Final = "--gripper-open 0.085 --gripper-closed 0 for an opening of 85 mm"


def find_gripper(
    tables: Sequence[JointTable], arm: JointTable, taken: Collection[str], stated: str, where: object
) -> tuple[JointTable, str]:
    """Find the column of the gripper, first in the table of the arm, then in the others.

    Args:
        taken: Columns that contain joints of the arm.
        stated: Name of the column; if empty, it is recognized by its name.
        where: The source, for messages.

    Raises:
        UnknownNameError: No table has the stated column.
        MalformedFileError: No column is recognized as the gripper.
        ConfigError: Several columns are recognized.
    """
    ordered = [arm, *(table for table in tables if table is not arm)]
    free = [
        (table, column)
        for table in ordered
        for column in table.columns
        if table is not arm or column not in taken
    ]
    if stated:
        for table, column in free:
            if column == stated:
                return table, column
        raise UnknownNameError("--gripper-column", stated, dict.fromkeys(column for _, column in free))
    for group in ([item for item in free if item[0] is arm], free):
        named = [item for item in group if item[1] == "gripper"] or [
            item for item in group if _GRIPPER.search(item[1])
        ]
        if len(named) == 1:
            return named[0]
        if named:
            raise ConfigError(
                where, f"has {len(named)} columns of a gripper: {', '.join(column for _, column in named)}",
                "choose one with --gripper-column",
            )  # fmt: skip
    listed = ", ".join(column for _, column in free[:20]) or "none"
    raise MalformedFileError(
        where, f"has no column of the gripper (other columns: {listed})", "name it with --gripper-column"
    )


def read_share(
    values: Array, column: str, opened: float | None, closed: float | None, where: object
) -> tuple[Array, str]:
    """Convert gripper values to shares of the stroke.

    A unit is recognized if the values and the initially open gripper of a demonstration exclude all others. These are
    0 .. 1, and counts of 0 .. 255, both with 0 for open.

    Args:
        values: (T,), in the unit of the recording.
        opened, closed: Values of the open and the closed gripper, if they are known.
        where: The source, for messages.

    Returns:
        Shares (T,), 0 open .. 1 closed, and a sentence about the unit.

    Raises:
        UnitsError: The unit or the direction is ambiguous, or values are outside the stated range.
        ConfigError: The values for open and closed are equal, or only the closed one is known.
    """
    low, high = float(values.min()), float(values.max())
    spans = f"'{column}' starts at {values[0]:.4g} and spans {low:.4g} to {high:.4g}"
    if opened is None and closed is not None:
        raise ConfigError("--gripper-closed", "is given without --gripper-open", "give both")
    if opened is None:
        opened, closed = _recognise(values, column, spans, where)
    elif closed is None:
        closed = _find_closed(opened, high, column, spans, where)
    if opened == closed:
        raise ConfigError(
            "--gripper-closed", f"is {closed:g} as --gripper-open", "give the column's values of both"
        )
    share = (values - opened) / (closed - opened)
    if not (share.min() >= -STROKE_SLACK and share.max() <= 1 + STROKE_SLACK):
        raise UnitsError(
            where, f"{spans}, outside {opened:g} (open) .. {closed:g} (closed)",
            "state both values: --gripper-open and --gripper-closed",
        )  # fmt: skip
    return np.clip(share, 0.0, 1.0), f"'{column}' is read as {opened:g} (open) .. {closed:g} (closed)"


def _recognise(values: Array, column: str, spans: str, where: object) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    is_share = low >= -STROKE_SLACK and high <= 1 + STROKE_SLACK
    if is_share and high <= MAX_OPENING_M and high - low >= GRIPPER_NOISE / 2:
        raise UnitsError(where, f"{spans}: is it an opening in meters?", f"state it: {EXAMPLES}")
    if is_share and _ANGLE.search(column):
        raise UnitsError(
            where, f"{spans}: an angle of the fingers?",
            "state it: --gripper-open 0 --gripper-closed 0.8 for the driver of a Robotiq 2F-85",
        )  # fmt: skip
    is_count = low >= -STROKE_SLACK * MAX_COUNT and MAX_PERCENT < high <= MAX_COUNT
    if not (is_share or is_count):
        raise UnitsError(
            where, f"{spans}: is the unit percent, millimeters or another one?",
            f"state the column's values of open and closed: {EXAMPLES} in meters",
        )  # fmt: skip
    top = 1.0 if is_share else 255.0
    if not values[0] <= OPEN * top:
        half = "closed" if values[0] >= CLOSED * top else "half open"
        raise UnitsError(
            where, f"{spans}: it starts {half} if 0 is open; reversed?",
            f"state which one is open: --gripper-open 0 or --gripper-open {top:g}",
        )  # fmt: skip
    return 0.0, top


def _find_closed(opened: float, high: float, column: str, spans: str, where: object) -> float:
    """Return the value of the closed gripper, derived from the value of the open gripper and the largest value."""
    if opened > 0:
        return 0.0  # the width of the opening, or a reversed share
    for least, most, top in _TOPS:
        if opened == 0 and least < high <= most and not _ANGLE.search(column):
            return top
    raise UnitsError(
        where,
        f"{spans}, which does not determine the closed gripper",
        "state it with --gripper-closed as well",
    )
