"""List of all samples (draws) of a run, finished or not: committed episodes, rejected and skipped samples."""

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from aomgen.episodes.ledger import (
    DRAWS_FILE,
    REJECTED_FOLDER,
    REQUEST_FILE,
    read_draws,
    read_request,
    unit_of,
)
from aomgen.errors import AomgenError, MissingFileError
from aomgen.io.artifact import read_json
from aomgen.io.episode_folder import EPISODE_FILE, list_committed
from aomgen.io.review import content_of
from aomgen.viewing.limit_readings import read_limits

# "damaged" is an episode whose episode.json cannot be read.
Outcome = Literal["committed", "rejected", "skipped", "damaged"]
UNKNOWN_ASSET: Final = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One sample (draw) for an asset and its outcome.

    Attributes:
        number: Number of the episode.
        asset: Name of the object.
        outcome: See `Outcome`.
        reason, detail: Reason and detail of a rejection; for an episode, the nearest limit and the metric in words.
        room: Normalized margin to the nearest limit (see `LimitReading`), negative beyond it; None without a limit.
        variation: The stored variation; empty if it is unknown.
        metrics: Metrics of a rejection.
        bodies: Names of the bodies whose overlap is the reason of the rejection.
        content: Digest of a committed episode, by which its review is found.
        cameras: Names of its videos.
    """

    number: int
    asset: str
    outcome: Outcome
    reason: str
    detail: str
    room: float | None = None
    variation: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    bodies: tuple[str, ...] = ()
    content: str = ""
    cameras: tuple[str, ...] = ()


class DrawList:
    """Samples of the run in a folder; files are read again only if they have changed.

    Args:
        out: Folder of the run.
        episodes: Folder of its stage "episodes".
    """

    def __init__(self, out: Path, episodes: Path) -> None:
        self.out, self.episodes = out, episodes
        self._lock = threading.Lock()
        self._found: dict[int, Draw] = {}
        self._known: dict[Path, tuple[tuple[int, int], list[Draw]]] = {}

    def read(self) -> list[Draw]:
        """Return all samples by number; the list is empty before the stage "episodes" has started.

        Raises:
            MissingFileError: The folder of the run does not exist any more.
            MalformedFileError: A file with information on all samples is damaged.
        """
        if not self.out.is_dir():
            raise MissingFileError(self.out, "is missing", "has it been moved or deleted?")
        with self._lock:
            self._found = {draw.number: draw for draw in self._list()}
            return [self._found[number] for number in sorted(self._found)]

    def find(self, number: int) -> Draw:
        """Return one sample as `read` last found it; if it was not found, all samples are read again.

        Raises:
            ValueError: There is no sample with this number.
        """
        if number not in self._found:
            self.read()
        if number not in self._found:
            raise ValueError(f"there is no draw {number}")
        return self._found[number]

    def _list(self) -> Iterator[Draw]:
        """Yield samples in the order of the files that report them; later files override earlier ones."""
        if not (self.episodes / REQUEST_FILE).is_file():
            return
        names = dict(enumerate(read_request(self.episodes).assets))
        yield from self._cached(self.episodes / DRAWS_FILE, _read_skipped)
        for path in (self.episodes / REJECTED_FOLDER).glob("[0-9]*.json"):
            yield from self._cached(path, lambda path: [_read_rejected(path, names)])
        for folder in list_committed(self.episodes):
            yield from self._cached(folder / EPISODE_FILE, lambda path: [_read_committed(path, names)])

    def _cached(self, path: Path, read: Callable[[Path], list[Draw]]) -> list[Draw]:
        """Return the samples of a file; none if it was deleted in the meantime."""
        try:
            status = path.stat()
        except FileNotFoundError:
            return []
        stamp = (status.st_mtime_ns, status.st_size)
        if path not in self._known or self._known[path][0] != stamp:
            try:
                self._known[path] = (stamp, read(path))
            except MissingFileError:
                return []
        return self._known[path][1]


def _read_skipped(path: Path) -> list[Draw]:
    return [
        Draw(
            number=int(item["number"]),
            asset=str(item["name"]),
            outcome="skipped",
            reason=str(item["reason"]),
            detail=str(item["detail"]),
            room=_room(item),
            variation=item["variation"],
        )
        for item in read_draws(path.parent)
        if item["outcome"] == "skipped"
    ]


def _read_rejected(path: Path, names: Mapping[int, str]) -> Draw:
    unit = unit_of(path.stem)
    asset = names.get(unit.asset, UNKNOWN_ASSET)
    try:
        item = read_json(path)
        return Draw(
            number=unit.number,
            asset=asset,
            outcome="rejected",
            reason=str(item["reason"]),
            detail=str(item["detail"]),
            room=_room(item),
            variation=item["variation"],
            metrics=item["metrics"],
            bodies=tuple(item.get("bodies", ())),
        )
    except MissingFileError:
        raise
    except (AomgenError, KeyError, TypeError) as error:
        return _describe_damage(unit.number, asset, path, error)


def _read_committed(path: Path, names: Mapping[int, str]) -> Draw:
    number = int(path.parent.name)
    asset = names.get(unit_of(number).asset, UNKNOWN_ASSET)
    try:
        header = read_json(path)
        nearest = read_limits(header["verdict"])[0]
        return Draw(
            number=number,
            asset=str(header["asset"]),
            outcome="committed",
            reason=nearest.name,
            detail=f"{nearest.value}, limit {nearest.limit}",
            room=nearest.room,
            variation=header["verdict"]["variation"],
            content=content_of(header, path),
            cameras=tuple(header["cameras"]),
        )
    except MissingFileError:
        raise
    except (AomgenError, KeyError, TypeError, ValueError, IndexError) as error:
        return _describe_damage(number, asset, path, error)


def _describe_damage(number: int, asset: str, path: Path, error: Exception) -> Draw:
    sentence = str(error) if isinstance(error, AomgenError) else f"{path}: is not complete ({error!r})"
    return Draw(number=number, asset=asset, outcome="damaged", reason="damaged", detail=sentence)


def _room(item: Mapping[str, Any]) -> float | None:
    # Runs of earlier versions do not state the excess.
    excess = item.get("excess")
    return None if excess is None else -excess
