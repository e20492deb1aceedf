"""Who was asked for how many episodes, and what has come of it, told by what lies in the stage's folder.

```
request.json          how many episodes of which assets
000005/               a committed episode: asset 0, draw 5
rejected/100002.json  an attempt that gave none, and why: asset 1, draw 2
objects/000005/       the object of an episode that has another size than its asset
draws.json            when all is done: every draw with its outcome, also those that were not tried
```
At any moment, requested = committed + rejected + left.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from aomgen.core.plan import Rejection, Variation
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from aomgen.io.episode_folder import list_committed

REQUEST_FILE, DRAWS_FILE = "request.json", "draws.json"
REJECTED_FOLDER, OBJECTS_FOLDER = "rejected", "objects"
# Draws of an asset at most: the number of an episode has five digits for them.
MAX_DRAWS: Final = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """One draw of one asset: what is worked on from the plan to the committed episode or the rejection."""

    asset: int
    index: int

    @property
    def number(self) -> int:
        """Of its episode."""
        return self.asset * MAX_DRAWS + self.index


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """Episodes wanted of each asset, by name and in the order of their numbers, and attempts allowed for them."""

    assets: tuple[str, ...]
    episodes: int
    attempts: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """What came of the episodes requested of one asset.

    Attributes:
        asset: Its name.
        requested, committed, rejected, left: Episodes; `rejected` are those that all attempts have failed to make.
        attempts: That have ended.
        reasons: How often each reason rejected an attempt, and how often a draw was not tried.
    """

    asset: str
    requested: int
    committed: int
    rejected: int
    attempts: int
    reasons: Mapping[str, int] = field(default_factory=dict)

    @property
    def left(self) -> int:
        """Episodes that are still to be made."""
        return self.requested - self.committed - self.rejected

    @property
    def why(self) -> str:
        """The reasons in words, the commonest first."""
        return ", ".join(f"{count} {reason}" for reason, count in self.reasons.items())


def write_request(folder: Path, request: Request) -> None:
    """Say what is wanted before any of it is made.

    Raises:
        StorageError: The disk refuses.
    """
    write_json(folder / REQUEST_FILE, asdict(request))


def write_rejection(folder: Path, unit: Unit, variation: Variation, rejection: Rejection) -> None:
    """Keep why an attempt gave no episode.

    Raises:
        StorageError: The disk refuses.
    """
    content = {"variation": asdict(variation), **asdict(rejection)}
    write_json(rejection_file(folder, unit), content)


def rejection_file(folder: Path, unit: Unit) -> Path:
    """Where it lies why an attempt gave no episode."""
    return folder / REJECTED_FOLDER / f"{unit.number:06d}.json"


def object_folder(folder: Path, unit: Unit) -> Path:
    """Where the USD of an episode's object lies that has another size than its asset."""
    return folder / OBJECTS_FOLDER / f"{unit.number:06d}"


def read_rejection(folder: Path, unit: Unit) -> Rejection:
    """Why an attempt gave no episode.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
    """
    path = rejection_file(folder, unit)
    content = read_json(path)
    try:
        return Rejection(**{name: content[name] for name in ("reason", "detail", "metrics")})
    except (TypeError, KeyError) as error:
        raise MalformedFileError(path, f"is no rejection ({error!r})", "delete it and run again") from error


def list_ended_units(folder: Path) -> tuple[set[Unit], set[Unit]]:
    """Units whose episode is committed, and those that were rejected."""
    rejected = (folder / REJECTED_FOLDER).glob("[0-9]*.json")
    return {unit_of(path.name) for path in list_committed(folder)}, {unit_of(path.stem) for path in rejected}


def unit_of(number: str | int) -> Unit:
    """The unit of an episode's number."""
    asset, index = divmod(int(number), MAX_DRAWS)
    return Unit(asset=asset, index=index)


def read_accounts(folder: Path) -> list[Account]:
    """What came of the request so far; nothing where there is none.

    Raises:
        MalformedFileError: A file is none of ours.
    """
    if not (folder / REQUEST_FILE).is_file():
        return []
    request = _read_request(folder / REQUEST_FILE)
    committed, rejected = list_ended_units(folder)
    finished = (folder / DRAWS_FILE).is_file()
    skipped = [draw for draw in read_draws(folder) if draw["outcome"] == "skipped"] if finished else []
    accounts = []
    for asset, name in enumerate(request.assets):
        made = sum(unit.asset == asset for unit in committed)
        failed = [unit for unit in rejected if unit.asset == asset]
        over = finished or made + len(failed) >= request.attempts
        reasons = Counter(read_rejection(folder, unit).reason for unit in failed)
        reasons.update(draw["reason"] for draw in skipped if draw["asset"] == asset)
        accounts.append(
            Account(
                asset=name,
                requested=request.episodes,
                committed=made,
                rejected=request.episodes - made if over else 0,
                attempts=made + len(failed),
                reasons=dict(reasons.most_common()),
            )
        )
    return accounts


def _read_request(path: Path) -> Request:
    content = read_json(path)
    try:
        return Request(
            assets=tuple(map(str, content["assets"])),
            episodes=int(content["episodes"]),
            attempts=int(content["attempts"]),
        )
    except (TypeError, KeyError, ValueError) as error:
        raise MalformedFileError(path, f"is no request ({error!r})", "delete it and run again") from error


def write_draws(folder: Path, draws: Iterator[dict[str, Any]]) -> None:
    """Keep every draw with its outcome: the request is done with.

    Raises:
        StorageError: The disk refuses.
    """
    write_json(folder / DRAWS_FILE, {"draws": list(draws)})


def read_draws(folder: Path) -> list[dict[str, Any]]:
    """Every draw of a finished stage: asset, number, variation, outcome ("committed", "rejected", "skipped"), reason.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
    """
    content = read_json(folder / DRAWS_FILE)
    try:
        return list(content["draws"])
    except (TypeError, KeyError) as error:
        raise MalformedFileError(folder / DRAWS_FILE, "holds no draws", "delete it and run again") from error
