"""The known objects of a planner are chosen once for a run, and again when the run changes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.episodes.factory import EpisodeFactory
from aomgen.errors import ConfigError
from aomgen.evaluation import known_objects
from aomgen.evaluation.known_objects import FIRST_SEED, open_known_objects
from toy_run import ToyResults, toy_run


@pytest.fixture
def results(tmp_path: Path) -> ToyResults:
    made = toy_run(tmp_path / "run")
    vars(made)["recorded"] = SimpleNamespace(category="drawer")
    vars(made)["motion"] = SimpleNamespace(direction="opening")
    return made


@pytest.fixture
def fitted_names(results: ToyResults, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Fit parametric objects like the toy drawer, and remember their names; the second one does not fit."""
    names = list[str]()

    def fit(_: ToyResults, asset: ArticulatedAsset) -> FittedAsset | Rejection:
        names.append(asset.name)
        if len(names) == 2:
            return Rejection(reason="too_small", detail="")
        return replace(results.fitted_assets[0], asset=asset)

    monkeypatch.setattr(known_objects, "fit_to_recording", fit)
    monkeypatch.setattr(EpisodeFactory, "_usual_grasp", lambda self, _: SimpleNamespace(usual=None))
    return names


def test_assets_of_the_run_and_parametric_objects_are_known(
    results: ToyResults, fitted_names: list[str]
) -> None:
    found = open_known_objects(results, 3)
    assert fitted_names == [f"drawer-{FIRST_SEED + number}" for number in range(3)]
    own = [fitted.asset.name for fitted in results.fitted_assets]
    assert [fitted.asset.name for fitted in found.fitted] == [*own, fitted_names[0], fitted_names[2]]
    first = found.fitted[0].asset
    assert (*first.static.meshes, *first.moving.meshes) == ()
    assert (find_keypoints(first) == find_keypoints(results.fitted_assets[0].asset)).all()


def test_they_are_chosen_once_for_each_number_and_twin(
    results: ToyResults, fitted_names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = open_known_objects(results, 1)
    again = open_known_objects(results, 1)
    assert fitted_names == [f"drawer-{FIRST_SEED}"]
    assert [item.asset.name for item in again.fitted] == [item.asset.name for item in first.fitted]
    assert len(open_known_objects(results, 0).fitted) == len(results.fitted_assets)
    monkeypatch.setattr(known_objects, "twin_digest", lambda results: "another twin")
    open_known_objects(results, 1)
    assert len(fitted_names) == 2


def test_the_usual_grasp_is_searched_without_the_twins(
    results: ToyResults, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: EpisodeFactory, number: int) -> None:
        raise AssertionError(f"asset {number} is opened")

    monkeypatch.setattr(EpisodeFactory, "_open_asset", refuse)
    vars(results)["fitted_assets"] = results.fitted_assets[:1]
    assert open_known_objects(results, 0).usual_grasp is not None


def test_a_run_of_a_closing_is_refused(results: ToyResults) -> None:
    vars(results)["motion"] = SimpleNamespace(direction="closing")
    with pytest.raises(ConfigError, match="demonstrates a closing"):
        open_known_objects(results, 0)
