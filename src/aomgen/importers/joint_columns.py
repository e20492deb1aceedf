"""Columns of a recording that contain the joints of the robot, and their conversion to radians."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.joint_log import MAX_ANGLE_RAD
from aomgen.core.values import Array
from aomgen.errors import (
    ConfigError,
    IncompleteCaptureError,
    MalformedFileError,
    UnitsError,
    UnknownNameError,
    suggest,
)
from aomgen.importers.recorded import JointTable

Unit = Literal["rad", "deg", "normalized"]
UNITS: Final[tuple[Unit, ...]] = get_args(Unit)
# Joints of LeRobot's calibrated arms are -100 .. 100 over their range; drivers overshoot by a few per cent.
MAX_NORMALIZED: Final = 102.0
# Largest angle of a joint that turns by up to one revolution, [deg]; with the same tolerance as in radians.
MAX_ANGLE_DEG: Final = float(np.degrees(MAX_ANGLE_RAD))
# Units at the end of a column name: `elbow [deg]`, `elbow_rad`, `q1 (degrees)`.
_UNIT_SUFFIX: Final = re.compile(r"[ _.]*[\[( _](deg|degs|degree|degrees|°|rad|rads|radian|radians)[\])]?$")
# Suffixes that programs append to the name of a joint.
_POSITION_SUFFIX: Final = re.compile(r"[ _./](pos|position|positions|joint|q|angle)$")


def read_column_unit(column: str) -> str:
    """Return the unit in a column name: "rad", "deg", or "" if there is none.

    Example:
        >>> read_column_unit("elbow [deg]"), read_column_unit("elbow_joint")
        ('deg', '')
    """
    found = _UNIT_SUFFIX.search(column.strip().lower())
    return "" if found is None else "rad" if found[1].startswith("rad") else "deg"


def _make_key(name: str) -> str:
    """Return a name without case, unit and suffix, so that `Elbow.pos` and `elbow_joint [deg]` are equal."""
    key = _UNIT_SUFFIX.sub("", name.strip().lower())
    while (shorter := _POSITION_SUFFIX.sub("", key)) != key:
        key = shorter
    return re.sub(r"[ _.\-/]+", "_", key).strip("_")


def find_columns(joint: str, columns: Sequence[str]) -> list[str]:
    """Return the columns that may contain a joint: those with its name, or else those whose names end with it.

    Example:
        >>> find_columns("elbow_joint", ["left_elbow_joint", "right_elbow_joint", "wrist_1_joint"])
        ['left_elbow_joint', 'right_elbow_joint']
    """
    if joint in columns:
        return [joint]
    key = _make_key(joint)
    keys = {column: _make_key(column) for column in columns}
    return [column for column in columns if keys[column] == key] or [
        column for column in columns if keys[column].endswith(f"_{key}")
    ]


def parse_joint_map(entries: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Return the column of each joint from entries `JOINT=COLUMN`, several of them separated by commas, or `PREFIX*`.

    Raises:
        ConfigError: An entry has another form.
        UnknownNameError: The robot has no such joint.
    """
    mapped: dict[str, str] = {}
    for entry in [part.strip() for item in entries for part in item.split(",")]:
        joint, equals, column = (part.strip() for part in entry.partition("="))
        if not equals and entry.count("*") == 1:
            mapped |= {name: entry.replace("*", name) for name in joints}
            continue
        if not (equals and joint and column):
            raise ConfigError(
                "--joint-map", f"'{entry}' is not JOINT=COLUMN", "as in elbow_joint=q3, or left_*"
            )
        if joint not in joints:
            raise UnknownNameError("--joint-map", joint, joints)
        mapped[joint] = column
    return mapped


def choose_table(
    tables: Sequence[JointTable], joints: Sequence[str], mapped: Mapping[str, str], topic: str, where: object
) -> tuple[JointTable, tuple[str, ...]]:
    """Find the table that contains all joints of the robot.

    Args:
        joints: Names of the robot's J joints.
        mapped: Stated columns by joint.
        topic: Stated name of the table, or empty.
        where: The source, for messages.

    Returns:
        The table, and the column of each joint.

    Raises:
        UnknownNameError: `topic` is not one of the tables.
        ConfigError: Two tables, or two columns of one table, match.
        MalformedFileError: No table contains all joints; the message suggests similar names.
    """
    if not tables:
        raise MalformedFileError(where, "holds no joint states", "choose a recording with the robot's joints")
    if topic:
        names = [table.name for table in tables]
        if topic not in names:
            raise UnknownNameError("--topic", topic, dict.fromkeys(names))
        tables = [table for table in tables if table.name == topic]
    found = [{joint: _find(joint, table, mapped) for joint in joints} for table in tables]
    complete = [k for k, columns in enumerate(found) if all(columns.values())]
    if len(complete) > 1:
        listed = ", ".join(tables[k].name for k in complete)
        raise ConfigError(
            where, f"holds joint states of {len(complete)} robots: {listed}", "choose one with --topic"
        )
    if not complete:
        _refuse_incomplete(tables, found, where)
    table, columns = tables[complete[0]], found[complete[0]]
    for joint, candidates in columns.items():
        if len(candidates) > 1:
            prefix = candidates[0].removesuffix(joint)
            raise ConfigError(
                where,
                f"holds {len(candidates)} columns for '{joint}': {', '.join(candidates)}",
                f"choose with --joint-map {joint}=COLUMN for each joint, or --joint-map '{prefix}*'",
            )
    return table, tuple(candidates[0] for candidates in columns.values())


def _find(joint: str, table: JointTable, mapped: Mapping[str, str]) -> list[str]:
    if joint in mapped:
        return [mapped[joint]] if mapped[joint] in table.columns else []
    return find_columns(joint, list(table.columns))


def _refuse_incomplete(
    tables: Sequence[JointTable], found: Sequence[Mapping[str, list[str]]], where: object
) -> None:
    best = max(range(len(tables)), key=lambda k: sum(map(bool, found[k].values())))
    missing = [joint for joint, columns in found[best].items() if not columns]
    columns, stated = list(tables[best].columns), f"--joint-map {missing[0]}=COLUMN"
    near = suggest(missing[0], columns)
    raise MalformedFileError(
        where,
        f"has no column for joint '{missing[0]}'"
        + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
        + f" (columns of {tables[best].name}: {', '.join(columns) or 'none'})",
        f"{near} State it with {stated}" if near.endswith("?") else f"state it with {stated}",
    )


def read_joints(
    table: JointTable,
    columns: Sequence[str],
    stated: str,
    read_limits: Callable[[], tuple[Array, NDArray[np.bool_]]],
    where: object,
) -> tuple[Array, str]:
    """Convert the joint values of a table to radians; prismatic joints are in meters, unless they are normalized.

    Args:
        columns: Columns of the J joints.
        stated: Unit of the columns, one of `UNITS`; if empty, it is recognized.
        read_limits: Returns the limits (J, 2) of the robot's joints, [rad] or [m], and the mask (J,) of the prismatic ones;
            called only if the columns are not obviously in radians.
        where: The source, for messages.

    Returns:
        Joint values (T, J), [rad] or [m], and a sentence about the unit.

    Raises:
        IncompleteCaptureError: The table has no rows.
        UnitsError: The unit cannot be determined, or the values contradict it.
    """
    values = np.column_stack([table.columns[column] for column in columns])
    if not len(values):
        raise IncompleteCaptureError(
            where, f"holds no joint states on {table.name}", "choose another recording"
        )
    read_limits = cache(read_limits)
    unit, reason = (stated, "--unit") if stated else _recognise(table, values, columns, read_limits, where)
    largest = _find_largest(values)
    note = f"joints are read as {unit} ({reason}; largest value {largest.max():.4g})"
    if unit == "rad" and largest.max() <= MAX_ANGLE_RAD:
        return values, note
    limits, slides = read_limits()
    is_angle = ~slides | (unit == "normalized")
    _check_largest(np.where(is_angle, largest, 0.0), columns, unit, reason, where)
    if not largest[~is_angle].max(initial=0.0) <= MAX_ANGLE_RAD:
        worst = int(np.argmax(np.where(is_angle, 0.0, largest)))
        raise UnitsError(
            where, f"'{columns[worst]}' of a prismatic joint reaches {largest[worst]:.1f}, limit {MAX_ANGLE_RAD:.2f} m",
            "convert the column to meters",
        )  # fmt: skip
    if unit == "deg":
        return np.where(slides, values, np.radians(values)), note
    if unit == "normalized":
        low, high = limits.T
        endless = ~np.isfinite(high - low)
        if endless.any():
            column = columns[int(np.argmax(endless))]
            raise UnitsError(
                where, f"'{column}' of a continuous joint cannot be normalized, because the joint has no limits",
                "state the unit: --unit rad or --unit deg",
            )  # fmt: skip
        return (
            low + (values + 100) / 200 * (high - low),
            f"{note}; -100 .. 100 are the limits of the robot's model",
        )
    return values, note


def _find_largest(values: Array) -> Array:
    """Return the largest magnitude (J,) of the values (T, J) of each joint."""
    return np.nan_to_num(np.abs(values)).max(0, initial=0.0)


def _check_largest(largest: Array, columns: Sequence[str], unit: str, reason: str, where: object) -> None:
    """Refuse magnitudes (J,) that a unit excludes."""
    limit = {"rad": MAX_ANGLE_RAD, "deg": MAX_ANGLE_DEG, "normalized": MAX_NORMALIZED}[unit]
    worst = int(np.argmax(largest))
    if not largest[worst] <= limit:
        raise UnitsError(
            where, f"'{columns[worst]}' reaches {largest[worst]:.1f}, limit {limit:.2f} for {unit} ({reason})",
            f"state the unit: --unit {' or '.join(name for name in UNITS if name != unit)}",
        )  # fmt: skip


def _recognise(
    table: JointTable,
    values: Array,
    columns: Sequence[str],
    read_limits: Callable[[], tuple[Array, NDArray[np.bool_]]],
    where: object,
) -> tuple[str, str]:
    """Return the unit of the revolute joints, and the evidence for it.

    Raises:
        UnitsError: Degrees and normalized joints explain the values equally well.
    """
    units = [read_column_unit(column) for column in columns]
    if len(set(units)) > 1:
        # The column of a prismatic joint states no unit of angles.
        units = [
            unit for unit, slides in zip(units, read_limits()[1], strict=True) if not (slides and not unit)
        ]
    if len(set(units)) > 1:
        raise UnitsError(
            where, f"names columns in several units ({', '.join(columns)})", "state it: --unit rad or deg"
        )
    if units[0]:
        return units[0], "the columns' names"
    if table.unit:
        return table.unit, "the format's unit"
    largest = _find_largest(values)
    if largest.max() <= MAX_ANGLE_RAD:
        return "rad", "all values are within a turn"
    largest = np.where(read_limits()[1], 0.0, largest)
    if largest.max() <= MAX_ANGLE_RAD:
        return "rad", "all angles are within a turn"
    if MAX_NORMALIZED < largest.max() <= MAX_ANGLE_DEG:
        return "deg", "values exceed 102"
    worst = int(np.argmax(largest))
    raise UnitsError(
        where,
        f"'{columns[worst]}' reaches {largest[worst]:.1f}: degrees, or normalized to -100 .. 100?",
        "state the unit: --unit deg or --unit normalized",
    )
