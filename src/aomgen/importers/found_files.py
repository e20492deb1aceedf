"""Files of a capture without capture.toml, the robot recognized from them, and a first capture.toml."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from aomgen.core.recording import CAPTURE_FILE
from aomgen.errors import ConfigError, InputError, MalformedFileError, MissingFileError, UnknownNameError
from aomgen.importers.capture_tables import JOINTS_FILE, DemoTables, write_new_capture
from aomgen.importers.csv_tables import RTDE, read_episode
from aomgen.importers.gripper_column import find_gripper
from aomgen.importers.import_demo import DEFAULT_ROBOT
from aomgen.importers.joint_columns import find_columns
from aomgen.io.atomic import write_text
from aomgen.robots.description import find_known_description, read_description

SCAN_VIDEO: Final = "scan.mp4"


def find_capture_files(capture: Path) -> tuple[DemoTables, tuple[str, ...]]:
    """Find scan, videos and log of a capture at their usual paths.

    Returns:
        Facts for a capture.toml, and the numeric columns of the log without the times. The robot is the known one whose joint
        names are columns; robot and joints are empty if there is none. The gripper is "" if no column or several columns have
        such a name.

    Raises:
        MissingFileError: One of them is missing; the message names the import that creates it.
        MalformedFileError: The log is an RTDE recording, whose columns are not named as joints.
        InputError: The log cannot be read.
    """
    scan = next((name for name in ("scan", SCAN_VIDEO) if (capture / name).exists()), "")
    if not scan:
        raise MissingFileError(
            capture / "scan", "is missing", f"import a scan with `aomgen import scan SOURCE {capture}`"
        )
    log, videos = capture / JOINTS_FILE, sorted((capture / "demo").glob("*.mp4"))
    for path, known in ((log, log.is_file()), (capture / "demo" / "front.mp4", bool(videos))):
        if not known:
            raise MissingFileError(
                path, "is missing", f"import a recording with `aomgen import demo SOURCE {capture}`"
            )
    recorded = read_episode(log)
    if recorded.kind == RTDE:
        # A run reads the columns by the names in the file.
        raise MalformedFileError(
            log, "is an RTDE recording", f"move it and import it with `aomgen import demo FILE {capture}`"
        )
    (table,) = recorded.tables
    joints = read_description(find_known_description(DEFAULT_ROBOT)).joints
    is_known = all(find_columns(joint, list(table.columns)) == [joint] for joint in joints)
    try:
        _, gripper = find_gripper([table], table, joints, "", log)
    except (ConfigError, InputError):
        gripper = ""
    tables = DemoTables(
        cameras=tuple(video.stem for video in videos),
        clock_offset_s=None,
        robot_model=DEFAULT_ROBOT if is_known else "",
        joints=tuple(joints) if is_known else (),
        gripper=gripper,
        scan=scan,
    )
    return tables, tuple(table.columns)


def describe_capture(capture: Path, tables: DemoTables, columns: Sequence[str]) -> Path:
    """Write a capture.toml; category and instruction are not filled in.

    Args:
        capture: Folder of the capture.
        tables: Facts about the capture; the joints are columns of the log, from base to flange.
        columns: Numeric columns of the log.

    Raises:
        UnknownNameError: The log does not have the column of a joint or of the gripper.
        StorageError: Writing to the disk failed.
    """
    for name in (*tables.joints, tables.gripper):
        if name not in columns:
            raise UnknownNameError(capture / JOINTS_FILE, name, dict.fromkeys(columns))
    path = capture / CAPTURE_FILE
    write_text(path, write_new_capture(capture.resolve().name, tables))
    return path
