"""Workers without access to the run's folders give the same run, through a store that may vanish."""

import importlib.util
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from aomgen.core.progress import silent
from aomgen.episodes import stage as stage_module
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import Unit, read_accounts
from aomgen.episodes.stored_units import RUN_FILE
from aomgen.errors import StorageError
from aomgen.executors import Done, Work
from aomgen.io.reuse import StoredFileWarning
from fault_run import PARAMS, InThisProcess
from fault_trees import read_tree
from toy_run import ToyResults, toy_run

pytestmark = pytest.mark.slow


class Stopped(Exception):
    """The run is stopped after a worker has put its unit into the store."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a store."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    make(toy_run(out, params=PARAMS))
    return out


@pytest.fixture
def results(whole: Path) -> ToyResults:
    """A run that has not begun, with a store in a folder."""
    if importlib.util.find_spec("fsspec") is None:
        pytest.skip("fsspec is not installed")
    out = whole.with_name("run")
    for path in (out, out.with_name("store")):
        shutil.rmtree(path, ignore_errors=True)
    return replace(toy_run(out, params=PARAMS), store=str(out.with_name("store")))


def make(results: ToyResults, heard: Callable[[Done], None] = lambda done: None) -> None:
    stage_module.run(results, results.folders["episodes"], silent, heard)


@contextmanager
def in_this_process(*, stop: bool = False) -> Iterator[list[Unit]]:
    """Run the only worker in this process, and yield the units that it makes."""
    made = list[Unit]()
    compute = EpisodeFactory.make

    def counted(factory: EpisodeFactory, unit: Unit) -> Any:
        made.append(unit)
        return compute(factory, unit)

    class Executor(InThisProcess):
        def next_done(self) -> Done:
            done = super().next_done()
            if stop:
                raise Stopped
            return done

    def open_executor(_: Any, opener: Callable[[], Work], __: float) -> Executor:
        return Executor(opener())

    with (
        patch.object(stage_module, "open_executor", open_executor),
        patch.object(EpisodeFactory, "make", counted),
    ):
        yield made


def test_workers_need_only_the_store(whole: Path, results: ToyResults) -> None:
    """Two processes, from which the inputs of the run are hidden when they have been put into the store."""
    fitted = results.folders["replacement"]
    hidden = fitted.with_name("hidden")
    opened = stage_module.open_executor

    def hide(*arguments: Any) -> Any:
        fitted.rename(hidden)
        return opened(*arguments)

    with patch.object(stage_module, "open_executor", hide):
        make(replace(results, workers=2))
    hidden.rename(fitted)
    assert read_tree(results.out, staging=True) == read_tree(whole)


def test_an_object_store_does_the_same(whole: Path, results: ToyResults) -> None:
    with in_this_process() as made:
        make(replace(results, store="memory://units/run"))
    assert len(made) >= 2
    assert read_tree(results.out, staging=True) == read_tree(whole)


def test_a_store_that_vanishes_stops_the_run_and_every_unit_is_accounted_for(
    whole: Path, results: ToyResults
) -> None:
    def vanish(done: Done) -> None:
        shutil.rmtree(results.store)

    with in_this_process() as made:
        with pytest.raises(StorageError, match=r"the store cannot be used .*same command again to continue"):
            make(results, vanish)
        before = len(made)
        make(results)
    assert before == 2, "the second unit found no store"
    first, *others = made
    assert first not in others
    assert read_tree(results.out, staging=True) == read_tree(whole)
    assert sum(account.left for account in read_accounts(results.folders["episodes"])) == 0


def test_units_of_an_interrupted_run_are_taken_from_the_store(whole: Path, results: ToyResults) -> None:
    with in_this_process(stop=True) as made, pytest.raises(Stopped):
        make(results)
    with in_this_process() as later:
        make(results)
    assert len(made) == 1
    assert made[0] not in later
    assert read_tree(results.out, staging=True) == read_tree(whole)


def test_a_damaged_unit_in_the_store_is_made_again_with_one_warning(whole: Path, results: ToyResults) -> None:
    with in_this_process(stop=True) as made, pytest.raises(Stopped):
        make(results)
    (archive,) = Path(results.store).glob("*/0*.zip")
    archive.write_bytes(archive.read_bytes()[:1000])
    with (
        in_this_process() as later,
        pytest.warns(StoredFileWarning, match=f"{archive.name}.*again") as warned,
    ):
        make(results)
    assert len(warned) == 1
    assert made[0] in later
    assert read_tree(results.out, staging=True) == read_tree(whole)


def test_units_of_other_inputs_are_not_taken(whole: Path, results: ToyResults) -> None:
    with in_this_process(stop=True) as made, pytest.raises(Stopped):
        make(results)
    (results.folders["episodes"] / RUN_FILE).unlink()  # as the runner does with the whole folder
    with in_this_process() as later:
        make(results)
    assert made[0] in later
    assert read_tree(results.out, staging=True) == read_tree(whole)
