"""Request episodes until every asset has enough, or the allowed number of samples has been planned.

The draws that are tried do not depend on the number of workers: no more draws of an asset
are begun than are missing.
"""

from collections.abc import Callable, Iterator, Set
from dataclasses import asdict, dataclass
from functools import partial
from itertools import filterfalse
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
from aomgen.executors import LOST, Done, Executor
from aomgen.io.atomic import remove_folder, remove_staging
from aomgen.io.episode_folder import episode_folder
from aomgen.io.reuse import reuse

# An asset is given up after this many skipped draws in a row: where one in a hundred fits, one is found.
MAX_SKIPPED: Final = 500

# Function that returns the variation of an asset's draw, and the reason why it is not worth trying, if any.
Screen = Callable[[Unit], tuple[Variation, Rejection | None]]


@dataclass(slots=True)
class _Quota:
    """State of the episodes of one asset: the number of draws, and their outcomes.

    Draws are not stored, because a request may have more than 100,000 of them: `screen` computes one again.
    `before` holds the committed and the rejected units of earlier processes.
    """

    asset: int
    wanted: int
    allowed: int
    screen: Screen
    before: tuple[Set[Unit], Set[Unit]]
    drawn: int = 0
    begun: int = 0
    running: int = 0
    committed: int = 0
    exhausted: bool = False

    def next_unit(self) -> Unit | None:
        """Return the next draw that is worth trying; None when none is missing, or no more are allowed.

        Draws that ended in an earlier process are counted, and not screened again.
        """
        committed, rejected = self.before
        skipped = 0
        while (
            self.committed + self.running < self.wanted and self.begun < self.allowed and not self.exhausted
        ):
            if skipped == MAX_SKIPPED or self.drawn == MAX_DRAWS:
                self.exhausted = True
                break
            unit = Unit(asset=self.asset, index=self.drawn)
            self.drawn += 1
            if unit in committed or unit in rejected:
                self.begun += 1
                self.committed += unit in committed
                skipped = 0
            elif self.screen(unit)[1] is None:
                self.begun += 1
                self.running += 1
                return unit
            else:
                skipped += 1
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
    rejected = {unit for unit in rejected if _is_readable(folder, unit)}
    quotas = [
        _Quota(asset, request.episodes, request.attempts, screen, (committed, rejected))
        for asset in range(len(request.assets))
    ]
    while not all(quota.over for quota in quotas):
        if sum(quota.running for quota in quotas) < executor.slots:
            unit = next(filter(None, (quota.next_unit() for quota in quotas)), None)
            if unit is not None:
                executor.submit(unit)
                continue
        if not any(quota.running for quota in quotas):
            continue
        done = executor.next_done()
        quota = quotas[done.unit.asset]
        if done.lost:
            lost = Rejection(reason=done.lost, detail=LOST[done.lost])
            write_rejection(folder, done.unit, screen(done.unit)[0], lost)
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


def _is_readable(folder: Path, unit: Unit) -> bool:
    """Return whether the rejection of a unit is readable; a damaged one is deleted with a warning."""
    path = rejection_file(folder, unit)
    if reuse(path, partial(read_rejection, folder, unit)) is None:
        remove_folder(path)
        return False
    return True


def _remove_staging(folder: Path) -> None:
    for place in (folder, folder / REJECTED_FOLDER, folder / OBJECTS_FOLDER):
        remove_staging(place)


def _forget_others(folder: Path, quotas: list[_Quota]) -> None:
    """Delete episodes, their objects and rejections beyond what is requested now."""

    def is_requested(unit: Unit) -> bool:
        return unit.asset < len(quotas) and unit.index < quotas[unit.asset].drawn

    committed, rejected = list_ended_units(folder)
    for unit in filterfalse(is_requested, committed):
        remove_folder(episode_folder(folder, unit.number))
    for unit in filterfalse(is_requested, rejected):
        rejection_file(folder, unit).unlink()
    for path in (folder / OBJECTS_FOLDER).glob("[0-9]*"):
        unit = unit_of(path.name)
        if unit not in committed or not is_requested(unit):
            remove_folder(path)


def _outcomes(
    folder: Path, request: Request, quotas: list[_Quota], committed: set[Unit]
) -> Iterator[dict[str, Any]]:
    """Yield every draw with its outcome."""
    for quota in quotas:
        for index in range(quota.drawn):
            unit = Unit(asset=quota.asset, index=index)
            outcome, (variation, rejection) = "skipped", quota.screen(unit)
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
