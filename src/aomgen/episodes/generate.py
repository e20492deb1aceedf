"""Request episodes until every asset has enough, or the allowed number of samples has been planned.

The draws that are tried do not depend on the number of workers: no more draws of an asset
are begun than are missing.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from aomgen.core.plan import Rejection, Variation
from aomgen.core.progress import Progress
from aomgen.episodes.ledger import (
    DRAWS_FILE,
    MAX_DRAWS,
    OBJECTS_FOLDER,
    REJECTED_FOLDER,
    Request,
    Unit,
    list_ended_units,
    read_rejection,
    rejection_file,
    unit_of,
    write_draws,
    write_rejection,
    write_request,
)
from aomgen.executors import Done, Executor
from aomgen.io.atomic import remove_folder, remove_staging
from aomgen.io.episode_folder import episode_folder

# An asset is given up after this many skipped draws in a row: where one in a hundred fits, one is found.
MAX_SKIPPED: Final = 500
LOST: Final = {
    "worker_died": "the process that worked on it died repeatedly",
    "timeout": "it took longer than the limit",
}

# Function that returns the variation of an asset's draw, and the reason why it is not worth trying, if any.
Screen = Callable[[Unit], tuple[Variation, Rejection | None]]


@dataclass(slots=True)
class _Quota:
    """State of the episodes of one asset: the draws made, and their outcomes."""

    asset: int
    wanted: int
    allowed: int
    screen: Screen
    draws: list[tuple[Variation, Rejection | None]] = field(default_factory=list)
    begun: int = 0
    running: int = 0
    committed: int = 0
    exhausted: bool = False

    def next_unit(self) -> Unit | None:
        """Return the next draw that is worth trying; None when none is missing, or no more are allowed."""
        if self.committed + self.running >= self.wanted or self.begun >= self.allowed or self.exhausted:
            return None
        skipped = 0
        while skipped < MAX_SKIPPED and len(self.draws) < MAX_DRAWS:
            unit = Unit(asset=self.asset, index=len(self.draws))
            variation, rejection = self.screen(unit)
            self.draws.append((variation, rejection))
            if rejection is None:
                self.begun += 1
                self.running += 1
                return unit
            skipped += 1
        self.exhausted = True
        return None

    def end(self, *, committed: bool) -> None:
        """Record that a unit has ended."""
        self.running -= 1
        self.committed += committed

    @property
    def over(self) -> bool:
        """Return whether no further unit will be made."""
        return not self.running and (
            self.committed >= self.wanted or self.begun >= self.allowed or self.exhausted
        )


def generate(
    folder: Path,
    request: Request,
    executor: Executor,
    screen: Screen,
    progress: Progress,
    on_done: Callable[[Done], None] = lambda done: None,
) -> None:
    """Make the requested episodes in a folder; existing ones are kept, and the ledger is closed at the end.

    Args:
        folder: Folder of all episodes of the same assets, demonstration and parameters, see `ledger`.
        request: Requested episodes.
        executor: Its work commits the episode of a `Unit` or writes its rejection, and returns first whether
            it was committed, see `EpisodeFactory.make`.
        screen: Screening of the draws.
        progress: Called after every unit.
        on_done: Receives every finished unit.

    Raises:
        StorageError: A file cannot be written.
        AomgenError: Any error that the work raises.
    """
    _remove_staging(folder)
    (folder / DRAWS_FILE).unlink(missing_ok=True)
    write_request(folder, request)
    committed, rejected = list_ended_units(folder)
    quotas = [
        _Quota(asset, request.episodes, request.attempts, screen) for asset in range(len(request.assets))
    ]
    while not all(quota.over for quota in quotas):
        if sum(quota.running for quota in quotas) < executor.slots:
            unit = next(filter(None, (quota.next_unit() for quota in quotas)), None)
            if unit is not None:
                if unit in committed or unit in rejected:
                    quotas[unit.asset].end(committed=unit in committed)
                else:
                    executor.submit(unit)
                continue
        if not any(quota.running for quota in quotas):
            continue
        done = executor.next_done()
        quota = quotas[done.unit.asset]
        if done.lost:
            lost = Rejection(reason=done.lost, detail=LOST[done.lost])
            write_rejection(folder, done.unit, quota.draws[done.unit.index][0], lost)
        successful = not done.lost and done.value[0]
        committed |= {done.unit} if successful else set()
        quota.end(committed=successful)
        on_done(done)
        made = sum(quota.committed for quota in quotas)
        tried = sum(quota.begun for quota in quotas)
        total = request.episodes * len(quotas)
        name = request.assets[done.unit.asset]
        progress(
            made / total, f"{made} of {total} committed, {tried - made} rejected or in progress ({name})"
        )
    _remove_staging(folder)  # of workers that have died meanwhile
    _forget_others(folder, quotas)
    write_draws(folder, _outcomes(folder, request, quotas, committed))


def _remove_staging(folder: Path) -> None:
    for place in (folder, folder / REJECTED_FOLDER, folder / OBJECTS_FOLDER):
        remove_staging(place)


def _forget_others(folder: Path, quotas: list[_Quota]) -> None:
    """Delete episodes, their objects and rejections beyond what is requested now."""
    asked = {Unit(asset=quota.asset, index=index) for quota in quotas for index in range(len(quota.draws))}
    committed, rejected = list_ended_units(folder)
    for unit in committed - asked:
        remove_folder(episode_folder(folder, unit.number))
    for unit in rejected - asked:
        rejection_file(folder, unit).unlink()
    for path in (folder / OBJECTS_FOLDER).glob("[0-9]*"):
        if unit_of(path.name) not in committed & asked:
            remove_folder(path)


def _outcomes(
    folder: Path, request: Request, quotas: list[_Quota], committed: set[Unit]
) -> Iterator[dict[str, Any]]:
    """Yield every draw with its outcome."""
    for quota in quotas:
        for index, (variation, screened) in enumerate(quota.draws):
            unit = Unit(asset=quota.asset, index=index)
            outcome, rejection = "skipped", screened
            if unit in committed:
                outcome = "committed"
            elif rejection is None:
                outcome, rejection = "rejected", read_rejection(folder, unit)
            yield {
                "asset": quota.asset,
                "name": request.assets[quota.asset],
                "number": unit.number,
                "variation": asdict(variation),
                "outcome": outcome,
                "reason": rejection.reason if rejection else "",
                "detail": rejection.detail if rejection else "",
                "excess": rejection.excess if rejection else None,
            }
