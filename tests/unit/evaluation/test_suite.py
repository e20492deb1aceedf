"""A suite says what every policy meets, belongs to one twin, and keeps away from the training."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.core.plan import Rejection, Variation
from aomgen.core.progress import silent
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.evaluation.draws import REFUSED_DRAWS, SuiteRequest, draw_trial, make_suite
from aomgen.evaluation.rollout import World
from aomgen.evaluation.suite import (
    Suite,
    nearest_pose,
    read_suite,
    require_apart,
    require_twin,
    training_poses,
    twin_digest,
    write_suite,
)
from aomgen.simulation.settings import draw_settings
from toy_run import ToyResults


def test_a_suite_comes_back_as_it_was(suite: Suite, toy: ToyResults, tmp_path: Path) -> None:
    write_suite(tmp_path / "again.json", suite)
    assert read_suite(tmp_path / "again.json").digest == suite.digest == suite.seal().digest
    assert [file.name for file in tmp_path.iterdir()] == ["again.json"]
    assert (toy.out / suite.run).resolve() == toy.out.resolve()
    assert len(suite.trials) == 3
    assert suite.max_frames > 60


def test_trials_depend_on_seed_and_number_alone(suite: Suite, world: World) -> None:
    request = SuiteRequest(trials=3, seed=9)
    again = draw_trial(world.factory, request, 1).trial
    assert (again.variation, again.setting) == (suite.trials[1].variation, suite.trials[1].setting)
    places = {(trial.variation.x, trial.variation.y, trial.variation.yaw) for trial in suite.trials}
    assert len(places) == 3
    other = draw_trial(world.factory, replace(request, seed=10), 1).trial
    assert other.variation != again.variation


def test_physical_parameters_with_which_nothing_opens_are_sampled_again(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    factory, request, tried = world.factory, SuiteRequest(trials=3, seed=9), list[int]()
    certify = factory.certify

    def refuse_first(opened: object, variation: Variation) -> object:
        tried.append(variation.index)
        first = Rejection(reason="target", detail="the gripper slips")
        return first if variation.index == 1 else certify(opened, variation)

    monkeypatch.setattr(factory, "certify", refuse_first)
    drawn = draw_trial(factory, request, 1)
    assert tried[:REFUSED_DRAWS] == [1] * REFUSED_DRAWS
    assert drawn.redrawn["target"] >= REFUSED_DRAWS
    assert drawn.trial.variation.index == tried[-1] > 1
    fitted = factory.asset(drawn.trial.asset).fitted
    assert drawn.trial.setting in draw_settings(fitted.asset, request.seed, tried[-1])


def test_no_trial_stands_where_an_episode_does(suite: Suite, toy: ToyResults) -> None:
    assert suite.nearest is not None
    assert suite.nearest.apart >= 1
    assert require_apart(suite, toy) == suite.nearest
    number, variation = next(
        (int(name), trial.variation) for name in training_poses(toy) for trial in suite.trials[:1]
    )
    from aomgen.episodes.ledger import unit_of

    drawn = World(suite, toy).factory.variation(unit_of(number))
    inside = replace(
        suite.trials[0], variation=replace(variation, x=drawn.x + 0.004, y=drawn.y, yaw=drawn.yaw)
    )
    with pytest.raises(ConfigError, match=r"trial 0 of the suite: is 4\.0 mm and 0\.00 deg from episode"):
        require_apart(replace(suite, trials=(inside,)), toy)


@pytest.mark.parametrize(
    ("mm", "deg", "apart"), [(4.9, 0.9, False), (5.1, 0.0, True), (0.0, 1.1, True), (100.0, 100.0, True)]
)
def test_poses_are_apart_in_place_or_in_angle(mm: float, deg: float, apart: bool) -> None:
    T = transform(matrix_from_rotvec([0, 0, np.deg2rad(deg)]), [mm / 1000, 0, 0])
    found = nearest_pose(T, {"far": transform(np.eye(3), [9.0, 0, 0]), "near": np.eye(4)})
    assert found is not None
    assert found[1] == "near"
    assert (found[0].apart >= 1) == apart
    np.testing.assert_allclose([found[0].mm, found[0].deg], [mm, deg], atol=1e-6)


def test_the_seed_of_the_training_is_refused(toy: ToyResults, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the seed of the run"):
        make_suite(toy, tmp_path / "s.json", SuiteRequest(seed=toy.project.seed), 1, silent)
    assert list(tmp_path.iterdir()) == []


def test_trials_of_other_ranges_are_not_continued(
    toy: ToyResults, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, request = tmp_path / "s.json", SuiteRequest(trials=1, seed=9)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("aomgen.evaluation.draws.write_suite", interrupt)
        make_suite(toy, path, request, 1, silent)
    params = {"episodes": {**toy.project.params["episodes"], "ranges": {"x_m": [0.0, 0.01]}}}
    changed = replace(toy, project=SimpleNamespace(**{**vars(toy.project), "params": params}))
    with pytest.raises(ConfigError, match="was begun for something else"):
        make_suite(changed, path, request, 1, silent)


def test_unknown_cameras_are_refused(toy: ToyResults, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'frnt' is not a camera of this run; did you mean 'front'\?"):
        make_suite(toy, tmp_path / "s.json", SuiteRequest(cameras=("frnt",)), 1, silent)
    assert list(tmp_path.iterdir()) == []


def test_the_robots_own_cameras_are_in_a_suite_that_names_them(toy: ToyResults, tmp_path: Path) -> None:
    request = SuiteRequest(trials=1, seed=9, cameras=("wrist", "front"))
    suite = make_suite(toy, tmp_path / "s.json", request, 1, silent)
    carried = toy.robot.cameras["wrist"][1]
    front = toy.episode_scene.cameras["front"]
    assert suite.cameras == {"wrist": carried, "front": front}
    assert suite.drawn_size == (front.width, front.height)
    with pytest.raises(
        ConfigError, match=r"selects only cameras on the robot; name one of front, .* as well"
    ):
        make_suite(toy, tmp_path / "t.json", replace(request, cameras=("wrist",)), 1, silent)


def test_a_run_that_draws_the_robots_cameras_has_them_in_its_suites(toy: ToyResults, tmp_path: Path) -> None:
    params = {"episodes": {**toy.project.params.get("episodes", {}), "images": {"robot_cameras": True}}}
    drawing = replace(toy, project=toy.project.model_copy(update={"params": params}))
    suite = make_suite(drawing, tmp_path / "s.json", SuiteRequest(trials=1, seed=9), 1, silent)
    assert list(suite.cameras) == [*toy.episode_scene.cameras, *toy.robot.cameras]


def test_pictures_larger_than_the_run_draws_are_refused(toy: ToyResults, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="9999x16 is larger than what the run draws"):
        make_suite(toy, tmp_path / "s.json", SuiteRequest(size=(9999, 16)), 1, silent)
    assert list(tmp_path.iterdir()) == []


def test_a_suite_of_another_twin_is_refused(suite: Suite, toy: ToyResults) -> None:
    require_twin(Path("suite.json"), suite, toy)
    assert suite.twin == twin_digest(toy)
    with pytest.raises(ConfigError, match="belongs to the twin 0000"):
        require_twin(Path("suite.json"), replace(suite, twin="0" * 64), toy)


def test_damaged_suites_are_refused(suite_file: Path, tmp_path: Path) -> None:
    text = suite_file.read_text()
    path = tmp_path / "damaged.json"
    content = json.loads(text)
    content["value"]["trials"][0]["variation"]["x"] += 0.01
    for changed in (json.dumps(content), text[: len(text) // 2], "{}", "[]"):
        path.write_text(changed)
        with pytest.raises(MalformedFileError):
            read_suite(path)
    with pytest.raises(MissingFileError):
        read_suite(tmp_path / "absent.json")
    with pytest.raises(ConfigError, match=r"ends in \.json"):
        read_suite(tmp_path / "suite.toml")
