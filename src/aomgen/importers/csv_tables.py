"""Episodes in text tables: CSV files of any layout, and RTDE recordings of Universal Robots."""

from pathlib import Path
from typing import Final

import numpy as np

from aomgen.capture.log_clock import find_time_column, read_times
from aomgen.capture.log_table import LogTable, read_log_table, read_number
from aomgen.errors import IncompleteCaptureError, MalformedFileError
from aomgen.importers.recorded import JointTable, RecordedEpisode

RTDE: Final = "RTDE recording"
# Measured joint angles in an RTDE recording, from base to flange, [rad].
RTDE_COLUMNS: Final = tuple(f"actual_q_{number}" for number in range(6))
# Names of these joints in the ROS driver and the models of all Universal Robots arms.
UR_JOINTS: Final = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip


def read_episode(path: Path) -> RecordedEpisode:
    """Read all numeric columns of a table; text columns are ignored.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: See `capture.log_table.read_log_table`; or the table
            has no column of times or of numbers.
        IncompleteCaptureError: The table has no rows.
    """
    table = read_log_table(path, ())
    if not table.rows:
        raise IncompleteCaptureError(path, "has no rows", "export the log again")
    name, _ = find_time_column(table.header)
    # A column name that occurs twice is ambiguous.
    once = [column for column in table.header if column and table.header.count(column) == 1]
    numeric = [column for column in once if column != name and _is_number(table, column)]
    times, notes = read_times(table, ())
    columns = {column: np.array(table.column(column, read_number)) for column in numeric}
    if not columns:
        raise MalformedFileError(path, "has no columns of numbers", "export the joint values in columns")
    kind, unit = "CSV", ""
    if all(column in columns for column in RTDE_COLUMNS):
        names = dict(zip(RTDE_COLUMNS, UR_JOINTS, strict=True))
        columns = {names.get(column, column): values for column, values in columns.items()}
        kind, unit = RTDE, "rad"
    return RecordedEpisode(
        kind=kind,
        tables=(JointTable(name=path.name, times_s=times, columns=columns, unit=unit),),
        notes=(*table.notes, *notes),
    )


def _is_number(table: LogTable, column: str) -> bool:
    """Return whether a column is numeric in the first row; later rows without a number are refused by name."""
    at = table.header.index(column)
    try:
        read_number(table.rows[0][at])
    except (ValueError, IndexError):
        return False
    return True
