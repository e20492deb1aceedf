"""Tables of `capture.toml` that follow from a demonstration: a new file, or the demo tables of an existing file."""

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict

from aomgen.capture.capture_schema import RobotSection
from aomgen.capture.manifest_text import PLACEHOLDER, parse_manifest_text, read_manifest_text, split_tables
from aomgen.errors import MalformedFileError
from aomgen.io.schema import format_toml_value, read_toml

JOINTS_FILE: Final = "demo/joints.csv"
_VIDEO: Final = re.compile(r"^(\s*video\s*=\s*)(\"[^\"\n]*\"|'[^'\n]*')", re.MULTILINE)
SKELETON: Final = """\
format = 1
{facts}
{robot}
[scan]
images = {scan}                       # TODO: folder of 40 to 100 stills from a walk around the scene, or a video
# intrinsics = [fx, fy, cx, cy]       # optional, in px

{demo}
# TODO: prompts; each part needs a box, preferably on two scan images:
# [[prompts]]
# part = "moving"                     # robot, moving or static
# image = "0003.jpg"
# points = [[312.0, 220.0, 1]]        # x, y [px], 1 on the part or 0 not on it
# box = [250.0, 150.0, 380.0, 300.0]  # x0, y0, x1, y1 [px]
"""
ROBOT: Final = """\
[robot]
{source} = {model}
joints = {joints}
gripper = {gripper}                   # 0 open .. 1 closed
scan_state = "first_row"              # TODO: the joint values during the scan, unless the log starts in that state
"""


class _RobotTable(BaseModel):
    """The part of a `capture.toml` that an import reads; all other parts may be missing."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    robot: RobotSection | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoTables:
    """Facts about the demonstration that an import finds.

    Attributes:
        cameras: Names of the cameras; each has the video `demo/NAME.mp4`.
        clock_offset_s: Time of the first frame on the clock of the log according to the recording's time stamps, [s];
            None if it is unknown. It does not include the latency of the camera, so it is written as a comment.
        robot_model: Name of a known robot, or URDF or MJCF file in the capture; used if there is no table [robot].
        joints: Names of the robot's joints.
        instruction: Language instruction, or "".
        gripper: Column of the gripper.
        scan: Folder of the scan images, or scan video.
    """

    cameras: Sequence[str]
    clock_offset_s: float | None
    robot_model: str
    joints: Sequence[str]
    instruction: str = ""
    gripper: str = "gripper"
    scan: str = "scan"


def read_robot_table(path: Path) -> RobotSection | None:
    """Return the table [robot] of a capture.toml; None if there is none.

    Raises:
        MalformedFileError, LimitExceededError: See `io.schema.read_toml`.
    """
    return read_toml(path, _RobotTable, "").robot


def write_new_capture(name: str, tables: DemoTables) -> str:
    """Return the text of a capture.toml with the known values, and with TODO comments for the others."""
    return SKELETON.format(
        facts="".join(_write_facts(name, tables).values()),
        robot=_write_robot(tables),
        scan=format_toml_value(tables.scan),
        demo=_write_demo(tables, {}),
    )


def replace_demo_tables(path: Path, tables: DemoTables) -> str:
    """Return the text of an existing capture.toml with other demo tables; all other bytes are kept.

    Name, category, instruction and robot are added if they are missing, as after the import of a scan into an empty folder.
    Cameras that keep their names keep their intrinsics and comments.

    Raises:
        MalformedFileError: The demo tables have a form that cannot be replaced.
    """
    text = read_manifest_text(path)
    blocks = split_tables(text)
    is_demo = [header == "demo" or header.startswith("demo.") for header, _ in blocks]
    kept = {}
    for header, block in blocks:
        if header == "demo.cameras":
            kept |= _read_camera(path, block)
    new = _write_demo(tables, kept) + "\n"
    before = parse_manifest_text(text, path)
    if sum(header == "demo.cameras" for header, _ in blocks) != len(
        before.get("demo", {}).get("cameras", [])
    ):
        raise _cannot_edit(path)  # cameras in one line, whose intrinsics would be lost
    if "robot" not in before:
        new = f"{_write_robot(tables)}\n{new}"
    at = is_demo.index(True) if any(is_demo) else len(blocks)
    head = "".join(block for (_, block), demo in zip(blocks[:at], is_demo, strict=False) if not demo)
    tail = "".join(block for (_, block), demo in zip(blocks[at:], is_demo[at:], strict=True) if not demo)
    gap = (
        ""
        if not head or head.endswith("\n\n") or head.endswith("\r\n\r\n")
        else "\n" * (2 - head.endswith("\n"))
    )
    result = f"{head}{gap}{new}{tail}" if tail else f"{head}{gap}{new}".rstrip("\n") + "\n"
    facts = _write_facts(path.resolve().parent.name, tables)
    result = _add_keys(result, {key: line for key, line in facts.items() if key not in before})
    _check_others(path, text, result)
    return result


def _write_facts(name: str, tables: DemoTables) -> dict[str, str]:
    """Return the lines of the facts about a capture, by key."""
    known = "language instruction of the demonstration"
    instruction = format_toml_value(tables.instruction or PLACEHOLDER)
    return {
        "name": f"name = {format_toml_value(name)}\n",
        "category": f'category = "{PLACEHOLDER}"                     # TODO: category of the object, for example '
        '"microwave"; it chooses assets\n',
        "instruction": f"instruction = {instruction}           # {'' if tables.instruction else 'TODO: '}{known}\n",
    }


def _add_keys(text: str, lines: dict[str, str]) -> str:
    """Add top-level keys below the existing ones."""
    if not lines:
        return text
    (_, head), *others = split_tables(text)
    return "".join([head.rstrip(), "\n", *lines.values(), "\n", *(block for _, block in others)])


def _read_camera(path: Path, block: str) -> dict[str, str]:
    """Return the text of a camera's table, by the name of the camera."""
    try:
        (camera,) = tomllib.loads(block)["demo"]["cameras"]
        return {str(camera["name"]): block.strip() + "\n"}
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise _cannot_edit(path) from error


def _write_robot(tables: DemoTables) -> str:
    source = {".urdf": "urdf", ".xml": "mjcf"}.get(Path(tables.robot_model).suffix.lower(), "model")
    return ROBOT.format(
        source=source,
        model=format_toml_value(tables.robot_model),
        joints=format_toml_value(list(tables.joints)),
        gripper=format_toml_value(tables.gripper),
    )


def _write_demo(tables: DemoTables, kept: dict[str, str]) -> str:
    parts = [_write_camera(name, kept.get(name, "")) for name in tables.cameras]
    demo = f'[demo]\njoints = "{JOINTS_FILE}"\n'
    if tables.clock_offset_s is not None:
        demo += (
            f"# clock_offset_s = {tables.clock_offset_s:.6f}   # by the stamps of the recording, without the latency of "
            "the camera; estimated when absent\n"
        )
    return "\n".join([*parts, demo])


def _write_camera(name: str, kept: str) -> str:
    video = format_toml_value(f"demo/{name}.mp4")
    if kept:
        return _VIDEO.sub(lambda found: found[1] + video, kept, count=1)
    return (
        f"[[demo.cameras]]\nname = {format_toml_value(name)}\nvideo = {video}\n"
        "# intrinsics = [fx, fy, cx, cy]       # optional, in px\n"
    )


def _check_others(path: Path, before: str, after: str) -> None:
    """Refuse a replacement that changed another table."""
    added = {"robot", "name", "category", "instruction"} - parse_manifest_text(before, path).keys()
    changed = {"demo"} | added
    try:
        kept = parse_manifest_text(after, path, without=changed)
    except MalformedFileError as error:
        raise _cannot_edit(path) from error
    if kept != parse_manifest_text(before, path, without=changed):
        raise _cannot_edit(path)


def _cannot_edit(path: Path) -> MalformedFileError:
    return MalformedFileError(
        path, "writes its demo tables in a form that cannot be replaced",
        "write them as [demo] and [[demo.cameras]], as docs/capture.md does",
    )  # fmt: skip
