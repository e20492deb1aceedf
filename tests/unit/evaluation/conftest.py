"""A toy run with an episode, and a suite of three trials in its twin."""

from pathlib import Path

import pytest

from aomgen.core.progress import silent
from aomgen.evaluation.draws import SuiteRequest, make_suite
from aomgen.evaluation.rollout import World
from aomgen.evaluation.suite import Suite
from toy_run import ToyResults, toy_episode

TRIALS = 3


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> ToyResults:
    return toy_episode(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="session")
def suite_file(toy: ToyResults) -> Path:
    path = toy.out / "suite.json"
    make_suite(toy, path, SuiteRequest(trials=TRIALS, seed=9), 1, silent)
    return path


@pytest.fixture(scope="session")
def suite(toy: ToyResults, suite_file: Path) -> Suite:
    from aomgen.evaluation.suite import read_suite

    return read_suite(suite_file)


@pytest.fixture(scope="session")
def world(toy: ToyResults, suite: Suite) -> World:
    return World(suite, toy)
