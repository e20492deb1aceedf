"""One recorded episode as every source yields it: joint tables by column name, and videos."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTable:
    """Measured values by column name, on the clock of the recording.

    Attributes:
        name: Topic, feature or file that holds them.
        times_s: (T,), in the order of the recording, [s].
        columns: Values (T,) by column name, in the units of the recording.
        unit: "rad" where the format defines the unit of joints; "" otherwise.
    """

    name: str
    times_s: Annotated[Array, "T"]
    columns: dict[str, Array]
    unit: str = ""

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenVideo:
    """Result of writing one video.

    Attributes:
        start_s: Time of the first frame on the clock of the joint tables, [s]; None where it is unknown.
        times_s: (T,), times of the frames in the written file, [s].
        notes: Sentences about frames that were dropped or re-encoded.
    """

    start_s: float | None
    times_s: Annotated[Array, "T"]
    notes: tuple[str, ...] = ()

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedVideo:
    """A video of the episode that is not decoded yet.

    Attributes:
        name: Proposed name of the camera; letters, digits, `_` and `-`.
        source: Topic, feature or file that holds it.
        write: Writes it to a new MP4 file in which the frames keep their distances in time.
    """

    name: str
    source: str
    write: Callable[[Path], WrittenVideo]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEpisode:
    """Everything that a source holds of one episode.

    Attributes:
        kind: Format of the source, for messages.
        tables: Joint tables.
        videos: Videos.
        instruction: Language instruction, "" where the source has none.
        notes: Sentences about what the reader assumed or skipped.
    """

    kind: str
    tables: tuple[JointTable, ...]
    videos: tuple[RecordedVideo, ...] = ()
    instruction: str = ""
    notes: tuple[str, ...] = ()
