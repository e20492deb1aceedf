"""Import of one recorded episode as the demonstration of a capture."""

import csv
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import av.error
import numpy as np
from numpy.typing import NDArray

from aomgen.capture.capture_schema import RobotSection
from aomgen.capture.joint_log import check_log, read_joint_log
from aomgen.core.recording import CAPTURE_FILE
from aomgen.core.values import Array
from aomgen.errors import (
    ConfigError,
    IncompleteCaptureError,
    InputError,
    MalformedFileError,
    NonFiniteError,
)
from aomgen.importers.camera_names import choose_videos
from aomgen.importers.capture_tables import (
    DemoTables,
    read_robot_table,
    replace_demo_tables,
    write_new_capture,
)
from aomgen.importers.gripper_column import find_gripper, read_share
from aomgen.importers.joint_columns import UNITS, choose_table, parse_joint_map, read_joints
from aomgen.importers.recorded import JointTable, RecordedEpisode, RecordedVideo
from aomgen.importers.sources import read_source
from aomgen.io.atomic import stage_folder, write_text
from aomgen.robots.description import find_known_description, read_description
from aomgen.robots.loading import load_robot

# Robot of a capture that does not state one.
DEFAULT_ROBOT: Final = "ur5e_2f85"
# Longest time at the start and the end of the arm's motion in which the gripper may have no values, [s]. Recorders subscribe to
# topics one after another, and the gripper rests there.
MAX_UNCOVERED_S: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """User's statements about a recording; empty or None if the value is to be recognized.

    Attributes:
        robot: Name of a known robot, for a capture that does not state one.
        unit: Unit of the joints: "rad", "deg" or "normalized".
        gripper_open, gripper_closed: Values of the gripper's column for the open and the closed gripper.
        gripper_column: Name of this column.
        joint_map: Entries `JOINT=COLUMN` or `PREFIX*`.
        topic: Topic of the joint states.
        cameras: Entries `NAME` or `NAME=SOURCE`.
        replace: Whether an existing demonstration of the capture is replaced.
    """

    robot: str = ""
    unit: str = ""
    gripper_open: float | None = None
    gripper_closed: float | None = None
    gripper_column: str = ""
    joint_map: tuple[str, ...] = ()
    topic: str = ""
    cameras: tuple[str, ...] = ()
    replace: bool = False


def import_demo(
    source: Path, capture: Path, episode: int = 0, options: ImportOptions = ImportOptions()
) -> tuple[str, ...]:
    """Write `demo/` and the demo tables of `capture.toml`; after an error, nothing is written.

    Args:
        source: A LeRobot dataset, a bag, an MCAP file or a text table.
        capture: Folder of the capture, which is created if it does not exist.
        episode: Number of the episode, from 0.

    Returns:
        Sentences about what was recognised, assumed or skipped.

    Raises:
        ConfigError: An option is wrong or missing, or the capture already has a demonstration.
        InputError: The source is damaged or incomplete, or its units cannot be recognized.
        BackendError: The library of the format is not installed.
        StorageError: The capture cannot be written.
    """
    if options.unit not in ("", *UNITS):
        raise ConfigError("--unit", f"is '{options.unit}'", f"expected {', '.join(UNITS)}")
    demo, manifest = capture / "demo", capture / CAPTURE_FILE
    if capture.exists() and not capture.is_dir():
        raise ConfigError(capture, "is a file", "give the folder of a capture")
    if demo.exists() and any(demo.iterdir()) and not options.replace:
        raise ConfigError(demo, "exists already", "replace it with --replace, or give another capture")
    robot = read_robot_table(manifest) if manifest.is_file() else None
    if robot is not None and options.robot:
        raise ConfigError("--robot", f"is given, but {manifest} names its robot", "leave it out")
    names = _list_joints(robot, options)
    recorded = read_source(source, episode)
    videos = choose_videos(recorded.videos, options.cameras, source)
    log, notes = _write_log(recorded, names, robot, options, capture, source)
    new_folder = not capture.exists()
    with stage_folder(capture if new_folder else demo) as staging:
        folder = staging / "demo" if new_folder else staging
        folder.mkdir(exist_ok=True)
        (folder / "joints.csv").write_text(log, "utf-8")
        start_s, lengths, video_notes = _write_videos(videos, folder, source)
        notes += video_notes + _check_log(folder / "joints.csv", names, robot, lengths, source)
        tables = DemoTables(
            cameras=list(lengths),
            clock_offset_s=start_s,
            robot_model=options.robot or DEFAULT_ROBOT,
            joints=names,
            instruction=recorded.instruction,
        )
        if manifest.is_file():
            text = replace_demo_tables(manifest, tables)
        else:
            text = write_new_capture(capture.resolve().name, tables)
        if new_folder:
            (staging / manifest.name).write_text(text, "utf-8")
    if not new_folder:
        write_text(manifest, text)
    if not options.cameras:
        used = [video.source for video in videos]
        notes += [
            f"{video.source} is left out, because its name is that of a camera on the arm"
            for video in recorded.videos
            if video.source not in used
        ]
    frames = ", ".join(f"{video.name} from {video.source}" for video in videos)
    rows = log.count("\n") - 1
    return (f"{recorded.kind}: {rows} rows of joints; cameras: {frames}", *recorded.notes, *notes)


def _list_joints(robot: RobotSection | None, options: ImportOptions) -> list[str]:
    """Return the names of the joints that the log of the capture needs."""
    if robot is not None:
        return list(robot.joints)
    return list(read_description(find_known_description(options.robot or DEFAULT_ROBOT)).joints)


def _write_log(
    recorded: RecordedEpisode,
    names: Sequence[str],
    robot: RobotSection | None,
    options: ImportOptions,
    capture: Path,
    source: Path,
) -> tuple[str, list[str]]:
    """Return the text of joints.csv, on the clock of the recording, and sentences about units and columns."""
    mapped = parse_joint_map(options.joint_map, names)
    arm, columns = choose_table(recorded.tables, names, mapped, options.topic, source)
    holder, column = find_gripper(recorded.tables, arm, columns, options.gripper_column, source)
    for table, name in [*((arm, name) for name in columns), (holder, column)]:
        _check_finite(table, name, source)
    limits = partial(_read_limits, robot, options, capture)
    joints, unit_note = read_joints(arm, columns, options.unit, limits, source)
    share, grip_note = read_share(
        holder.columns[column], column, options.gripper_open, options.gripper_closed, source
    )
    if holder is not arm:
        share = _resample(share, holder, arm, source)
        grip_note += f", from {holder.name}"
    opened, closed = (robot.gripper_range if robot is not None else None) or (0.0, 1.0)
    rows = np.column_stack([arm.times_s, joints, opened + share * (closed - opened)])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time_s", *names, "gripper" if robot is None else robot.gripper])
    writer.writerows([f"{value:.9f}" for value in row] for row in rows)
    pairs = [f"{name} = {found}" for name, found in zip(names, columns, strict=True) if name != found]
    mapping = [f"joints are taken from other columns: {', '.join(pairs)}"] if pairs else []
    return text.getvalue(), [*mapping, unit_note, grip_note]


def _resample(share: Array, holder: JointTable, arm: JointTable, source: Path) -> Array:
    """Interpolate the gripper's values (T,) in one table at the times of another table.

    Raises:
        IncompleteCaptureError: The gripper's values do not cover the times of the arm.
    """
    times_s, wanted_s = holder.times_s, arm.times_s
    if (
        holder.recorded_s is not None
        and arm.recorded_s is not None
        and (np.array_equal(times_s, holder.recorded_s) or np.array_equal(wanted_s, arm.recorded_s))
    ):
        # One table has no time stamps, and those of the other table may be on another clock than the recorder.
        times_s, wanted_s = holder.recorded_s, arm.recorded_s
    if not (
        times_s.min() <= wanted_s.min() + MAX_UNCOVERED_S
        and times_s.max() >= wanted_s.max() - MAX_UNCOVERED_S
    ):
        raise IncompleteCaptureError(
            source,
            f"{holder.name} has values from {times_s.min():.2f} s to {times_s.max():.2f} s, "
            f"{arm.name} from {wanted_s.min():.2f} s to {wanted_s.max():.2f} s",
            "record both during the whole demonstration, with time stamps of one clock",
        )
    order = np.argsort(times_s, kind="stable")
    return np.interp(wanted_s, times_s[order], share[order])


def _check_finite(table: JointTable, column: str, source: Path) -> None:
    finite = np.isfinite(table.columns[column]) & np.isfinite(table.times_s)
    if not finite.all():
        row = int(np.argmin(finite))
        raise NonFiniteError(
            source,
            f"row {row} of {table.name}, column '{column}' or its time is not finite",
            "record it again",
        )


def _read_limits(
    robot: RobotSection | None, options: ImportOptions, capture: Path
) -> tuple[Array, NDArray[np.bool_]]:
    """Read the limits (J, 2) of the robot's joints, [rad] or [m], and the mask (J,) of the prismatic joints."""
    if robot is None:
        model = load_robot(options.robot or DEFAULT_ROBOT)
    else:
        file = robot.urdf or robot.mjcf
        model = load_robot(capture / file if file else robot.model, joints=robot.joints, root=capture)
    return model.joint_limits, model.slides


def _write_videos(
    videos: Sequence[RecordedVideo], folder: Path, source: Path
) -> tuple[float | None, dict[str, float], list[str]]:
    """Write all videos; return the time of the first frame of the first one, lengths by camera, [s], and notes."""
    start_s: float | None = None
    lengths: dict[str, float] = {}
    notes: list[str] = []
    for video in videos:
        with _name_source(f"{source}, {video.source}", folder):
            written = video.write(folder / f"{video.name}.mp4")
        start_s = written.start_s if not lengths else start_s
        lengths[video.name] = float(written.times_s[-1] - written.times_s[0])
        notes += written.notes
    return start_s, lengths, notes


def _check_log(
    path: Path, names: Sequence[str], robot: RobotSection | None, lengths: dict[str, float], source: Path
) -> list[str]:
    """Read the written log in the same way as a run, and compare it with the videos.

    Raises:
        InputError: The log is invalid; the message names the source.
    """
    gripper, stated = ("gripper", ()) if robot is None else (robot.gripper, tuple(robot.gripper_range or ()))
    with _name_source(source, path):
        log, found = read_joint_log(path, names, gripper, stated)
        warnings = [*found, *check_log(log, path, lengths, None)]
    return [warning.removeprefix(f"{path}: ") for warning in warnings]


@contextmanager
def _name_source(source: object, staged: Path) -> Iterator[None]:
    """Replace the staged file by the source in all errors of the block.

    Raises:
        InputError: The block raised it, or the video library failed.
    """
    try:
        yield
    except InputError as error:
        if str(staged) not in error.where:
            raise
        raise type(error)(source, error.problem, error.remedy) from error
    except av.error.FFmpegError as error:
        raise MalformedFileError(
            source, f"has a video that cannot be written ({error})", "record it again"
        ) from error
