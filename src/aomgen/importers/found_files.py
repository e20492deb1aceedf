"""Files of a capture without capture.toml, the robot recognized from them, and a first capture.toml."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from aomgen.errors import ConfigError, InputError, MissingFileError, UnknownNameError
from aomgen.importers.capture_tables import JOINTS_FILE, DemoTables, write_new_capture
from aomgen.importers.csv_tables import read_episode
from aomgen.importers.gripper_column import find_gripper
from aomgen.importers.import_demo import DEFAULT_ROBOT
from aomgen.importers.joint_columns import find_columns
from aomgen.io.atomic import write_text
from aomgen.robots.description import find_known_description, read_description

SCAN_VIDEO: Final = "scan.mp4"


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundFiles:
    """Files of a capture, and the recognized robot.

    Attributes:
        scan: Folder of images or video, as named in capture.toml.
        cameras: Names of the videos `demo/NAME.mp4`.
        columns: Numeric columns of the log, without the times.
        robot: Known robot whose joint names are columns; "" if there is none.
        joints: Joints of this robot; empty if there is none.
        gripper: Column of the gripper; "" if no column or several columns have such a name.
    """

    scan: str
    cameras: tuple[str, ...]
    columns: tuple[str, ...]
    robot: str
    joints: tuple[str, ...]
    gripper: str


def find_capture_files(capture: Path) -> FoundFiles:
    """Find scan, videos and log of a capture at their usual paths.

    Raises:
        MissingFileError: One of them is missing; the message names the import that creates it.
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
    (table,) = read_episode(log).tables
    joints = read_description(find_known_description(DEFAULT_ROBOT)).joints
    is_known = all(find_columns(joint, list(table.columns)) == [joint] for joint in joints)
    try:
        _, gripper = find_gripper([table], table, joints, "", log)
    except (ConfigError, InputError):
        gripper = ""
    return FoundFiles(
        scan=scan,
        cameras=tuple(video.stem for video in videos),
        columns=tuple(table.columns),
        robot=DEFAULT_ROBOT if is_known else "",
        joints=tuple(joints) if is_known else (),
        gripper=gripper,
    )


def describe_capture(
    capture: Path, found: FoundFiles, robot: str, joints: Sequence[str], gripper: str
) -> Path:
    """Write a capture.toml; category and instruction are not filled in.

    Args:
        robot: Name of a known robot, or URDF or MJCF file in the capture.
        joints: Columns of the robot's joints, from base to flange.
        gripper: Column of the gripper.

    Raises:
        UnknownNameError: The log has no such column.
        StorageError: Writing to the disk failed.
    """
    for name in (*joints, gripper):
        if name not in found.columns:
            raise UnknownNameError(capture / JOINTS_FILE, name, dict.fromkeys(found.columns))
    tables = DemoTables(
        cameras=found.cameras,
        clock_offset_s=None,
        robot_model=robot,
        joints=joints,
        gripper=gripper,
        scan=found.scan,
    )
    path = capture / "capture.toml"
    write_text(path, write_new_capture(capture.resolve().name, tables))
    return path
