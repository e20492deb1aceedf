"""`run.json`: when and by which command a run was made; manifests hold no clock, this file does."""

from dataclasses import asdict, dataclass
from pathlib import Path

from aomgen.errors import CorruptArtifactError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json

RUN_RECORD = "run.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """The last command that changed a run.

    Attributes:
        command: As it was typed.
        version: Of AOMGen.
        finished: ISO 8601, with the offset from UTC.
    """

    command: str
    version: str
    finished: str


def save_record(out: Path, record: RunRecord) -> None:
    """Write the record into a run's folder."""
    write_json(out / RUN_RECORD, asdict(record))


def load_record(out: Path) -> RunRecord | None:
    """The record of a run, None when no command has finished there.

    Raises:
        CorruptArtifactError: The file holds something else.
    """
    path = out / RUN_RECORD
    if not path.is_file():
        return None
    try:
        return RunRecord(**read_json(path))
    except TypeError as error:
        raise CorruptArtifactError(path, "is not the record of a run", "delete it") from error
