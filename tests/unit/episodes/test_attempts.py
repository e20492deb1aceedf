"""Attempts are kept one by one, do not depend on each other, and are not made twice."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import FittedAsset, Rejection, Variation, VerifiedEpisode
from aomgen.episodes import generate
from aomgen.episodes.generate import GenerationParams, PoseRanges, generate_episodes
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.plans_stage import FOLDER, generate_in, load_generalization, read_attempt, recall_attempt
from aomgen.errors import MalformedFileError, NotEnoughEpisodesError
from aomgen.robots.robot import RobotModel
from toy_drawer import SUPPORT, fitted_drawer, opening

PARAMS = GenerationParams(count=2, seed=5, ranges=PoseRanges(x_m=(-0.02, 0.05), yaw_deg=(-15, 15)))


@pytest.fixture(scope="module")
def fitted() -> FittedAsset:
    return fitted_drawer()


@pytest.fixture(scope="module")
def demo(robot: RobotModel, fitted: FittedAsset) -> Demonstration:
    return opening(ik_solver(robot), fitted)


@pytest.fixture(scope="module")
def whole(robot: RobotModel, demo: Demonstration, fitted: FittedAsset, tmp_path_factory) -> Path:
    """What an undisturbed run leaves."""
    folder = tmp_path_factory.mktemp("whole")
    generate_in(folder, [fitted], demo, robot, SUPPORT, PARAMS, lambda share, text: None)
    return folder


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """Indices of the variations that are planned from now on."""
    indices: list[int] = []
    plan = generate.plan_episode

    def counted(fitted, demo, variation, *rest):
        indices.append(variation.index)
        return plan(fitted, demo, variation, *rest)

    monkeypatch.setattr(generate, "plan_episode", counted)
    return indices


def tree(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_run_that_stops_anywhere_continues_to_the_same_bytes(robot, demo, fitted, whole, tmp_path, made):
    def stop(share: float, text: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate_in(tmp_path, [fitted], demo, robot, SUPPORT, PARAMS, stop)
    assert made == [0]
    # As if the process had died between the two files of an attempt.
    (tmp_path / FOLDER / "5-00001.npz").write_bytes(b"half")
    generate_in(tmp_path, [fitted], demo, robot, SUPPORT, PARAMS, lambda share, text: None)
    assert made == [0, 1]
    assert tree(tmp_path) == tree(whole)


def test_an_attempt_does_not_depend_on_those_before_it(robot, demo, fitted, whole, tmp_path, made):
    shutil.copytree(whole, tmp_path / "run")
    for path in (tmp_path / "run" / FOLDER).glob("5-00001.*"):
        path.unlink()
    generate_in(tmp_path / "run", [fitted], demo, robot, SUPPORT, PARAMS, lambda share, text: None)
    assert made == [1], "the second attempt alone, with a solver and a scene of its own"
    assert tree(tmp_path / "run") == tree(whole)


def test_fewer_are_taken_from_what_is_there(robot, demo, fitted, whole, tmp_path, made):
    folder = Path(shutil.copytree(whole, tmp_path / "run"))
    one = replace(PARAMS, count=1)
    generate_in(folder, [fitted], demo, robot, SUPPORT, one, lambda share, text: None)
    assert made == []
    assert sorted(tree(folder / FOLDER)) == ["5-00000.json", "5-00000.npz"]
    (episode,) = load_generalization(folder, [fitted])
    assert episode.plan.variation.index == 0


def test_attempts_stay_when_there_are_too_few_episodes(robot, demo, fitted, tmp_path, made):
    short = replace(fitted, thetas=fitted.thetas / 3)  # below the travel that counts
    params = replace(PARAMS, count=1, attempts_per_episode=2)
    for _ in range(2):
        with pytest.raises(
            NotEnoughEpisodesError, match=r"2 target_too_small.*those that are verified are kept"
        ):
            generate_in(tmp_path, [short], demo, robot, SUPPORT, params, lambda share, text: None)
        assert made == [0, 1]
        assert sorted(tree(tmp_path)) == [f"{FOLDER}/5-00000.json", f"{FOLDER}/5-00001.json"]


def test_what_is_read_back_is_what_was_made(robot, demo, fitted, whole):
    first = load_generalization(whole, [fitted])[0]
    one = replace(PARAMS, count=1)
    made = generate_episodes([fitted], demo, robot, SUPPORT, one, lambda share, text: None).episodes[0]
    assert isinstance(first, VerifiedEpisode)
    assert first.verdict == made.verdict
    assert first.plan.metrics == made.plan.metrics
    assert first.plan.joints.tobytes() == made.plan.joints.tobytes()
    assert first.contacts.forces.tobytes() == made.contacts.forces.tobytes()


def test_a_rejection_keeps_its_figures(fitted, tmp_path):
    rejection = Rejection(reason="collision", detail="the hand", metrics={"penetration_mm": 1.7})
    variation = Variation(seed=3, index=7, x=0.0, y=0.0, yaw=0.0)
    assert recall_attempt(tmp_path, fitted, variation, lambda: rejection) == rejection
    assert recall_attempt(tmp_path, fitted, variation, lambda: pytest.fail("made twice")) == rejection


def test_records_that_cannot_be_used_are_refused(fitted, whole, tmp_path):
    folder = Path(shutil.copytree(whole, tmp_path / "run"))
    record = folder / FOLDER / "5-00000.json"
    with pytest.raises(MalformedFileError, match=r"drawer-1' is unknown; known assets: other"):
        read_attempt(folder, "5-00000", {"other": fitted})
    content = json.loads(record.read_text())
    for damage, message in (
        ({"verdict": None}, "no Attempt"),
        ({"plan": {}}, "no attempt"),
    ):
        episode = {**content["value"]["episode"], **damage}
        record.write_text(json.dumps({**content, "value": {**content["value"], "episode": episode}}))
        with pytest.raises(MalformedFileError, match=message):
            load_generalization(folder, [fitted])
    rejection = {"reason": "collision", "detail": "", "metrics": {}}
    value = {"asset": fitted.asset.name, "episode": None, "rejection": rejection}
    record.write_text(json.dumps({**content, "value": value}))
    with pytest.raises(MalformedFileError, match="no verified episode"):
        load_generalization(folder, [fitted])
