"""Common form of a recorded episode from any source: joint tables by column name, and videos."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTable:
    """Measured values by column name, on the clock of the recording.

    Attributes:
        name: Topic, feature or file of the values.
        times_s: (T,), in the order of the recording, [s].
        columns: Values (T,) by column name, in the units of the recording.
        unit: "rad" if the format defines the unit of joints, else "".
        recorded_s: Times (T,) on the clock of the recorder, which all tables share, [s]; None if the format has none. They
            equal `times_s` if the values have no time stamps.
    """

    name: str
    times_s: Annotated[Array, "T"]
    columns: dict[str, Array]
    unit: str = ""
    recorded_s: Annotated[Array, "T"] | None = None

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenVideo:
    """Result of writing one video.

    Attributes:
        start_s: Time of the first frame on the clock of the joint tables, [s]; None if it is unknown.
        times_s: Times (T,) of the frames in the written file, [s].
        notes: Sentences about frames that were dropped or re-encoded.
    """

    start_s: float | None
    times_s: Annotated[Array, "T"]
    notes: tuple[str, ...] = ()

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedVideo:
    """A video of the episode that is not yet decoded.

    Attributes:
        name: Proposed name of the camera; letters, digits, `_` and `-`.
        source: Topic, feature or file of the video.
        write: Function that writes the video to a new MP4 file and keeps the time intervals between frames.
    """

    name: str
    source: str
    write: Callable[[Path], WrittenVideo]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEpisode:
    """All data of one episode from a source.

    Attributes:
        kind: Format of the source, for messages.
        tables: Joint tables.
        videos: Videos.
        instruction: Language instruction, or "" if the source has none.
        notes: Sentences about assumptions of the reader and skipped data.
    """

    kind: str
    tables: tuple[JointTable, ...]
    videos: tuple[RecordedVideo, ...] = ()
    instruction: str = ""
    notes: tuple[str, ...] = ()
