"""Recognition of a recording's format by its content."""

from pathlib import Path
from typing import Final

from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.importers import csv_tables, lerobot, ros_bags
from aomgen.importers.recorded import RecordedEpisode
from aomgen.importers.ros_bags import BagKind

# First bytes of files that contain an episode.
_MAGICS: Final[dict[bytes, BagKind]] = {
    b"#ROSBAG V2.0": "ROS 1 bag",
    b"\x89MCAP0\r\n": "MCAP",
    b"SQLite format 3\0": "ROS 2 database",
}
KNOWN: Final = "a LeRobot dataset, a ROS 1 bag, a ROS 2 bag, an MCAP file, or a table of text (CSV, RTDE)"


def read_source(source: Path, number: int) -> RecordedEpisode:
    """Read one episode of a recording.

    Args:
        number: Number of the episode, from 0; bags and tables contain one.

    Raises:
        MissingFileError: The source does not exist.
        ConfigError: The episode does not exist.
        AomgenError: The reader of the format failed.
    """
    if not source.exists():
        raise MissingFileError(source, "is missing", f"give {KNOWN}")
    if source.is_dir() and (source / lerobot.INFO_FILE).is_file():
        return lerobot.read_episode(source, number)
    kind = _recognise(source)
    if number != 0:
        raise ConfigError("--episode", f"is {number}, but {source} has 1 episode", "expected 0")
    if kind is None:
        return csv_tables.read_episode(source)
    return ros_bags.read_episode(source, kind)


def _recognise(source: Path) -> BagKind | None:
    """Return the kind of a bag; None for a text table."""
    if source.is_dir():
        if (source / "metadata.yaml").is_file():
            return "ROS 2 bag"
        listed = ", ".join(sorted(item.name for item in source.iterdir())[:10]) or "nothing"
        raise MalformedFileError(source, f"is a folder with {listed}", f"give {KNOWN}")
    with source.open("rb") as file:
        start = file.read(16)
    if not start:
        raise MalformedFileError(source, "is empty", f"give {KNOWN}")
    return next((kind for magic, kind in _MAGICS.items() if start.startswith(magic)), None)
