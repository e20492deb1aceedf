"""Policies are judged over processes; rollouts that are there are kept, failures are filmed."""

import json
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.progress import silent
from aomgen.errors import ConfigError, MissingFileError
from aomgen.evaluation.evaluate import (
    FILMED,
    EvaluationRequest,
    evaluate,
    interval_95,
    place_side_by_side,
    roll_out,
)
from aomgen.evaluation.policies import NearestReplay, open_policy
from aomgen.evaluation.rollout import World
from aomgen.evaluation.suite import Suite
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from aomgen.io.video import read_video
from toy_run import ToyResults


class Still:
    """Stays where it is, and looks at every second frame; then it locates keypoints 3 mm off."""

    points_world: np.ndarray | None = None

    def __init__(self) -> None:
        self.looked: list[bool] = []

    def reset(self, rollout) -> None:
        self.points_world = rollout.locate_keypoints() + [0, 0, 0.003]
        self._action = np.append(rollout.trial.joints, 0.0)

    def looks(self, frame: int) -> bool:
        return frame % 2 == 0

    def act(self, observation) -> np.ndarray:
        self.looked.append("pixels" in observation)
        return self._action


@pytest.mark.slow
def test_an_evaluation_counts_resumes_and_films(suite: Suite, toy: ToyResults, tmp_path: Path) -> None:
    out, request = tmp_path / "out", EvaluationRequest(policy="oracle_replay")
    figures = evaluate(suite, toy, out, request, 1, silent)
    assert (figures["trials"], figures["successes"], figures["failures"]) == (3, 3, {})
    assert figures["interval_95"] == interval_95(3, 3)
    assert figures["suite"] == suite.digest
    # What is there is not done again, and what failed becomes a video.
    place = out / "rollouts" / "0001.json"
    stored = read_json(place)
    stored["value"]["fail_reason"] = "made_up"
    write_json(place, stored)
    (out / "rollouts" / "0002.json").unlink()
    again = evaluate(suite, toy, out, request, 1, silent)
    assert (again["successes"], again["failures"]) == (2, {"made_up": 1})
    assert again["rollouts"][2] == figures["rollouts"][2]
    video = read_video(out / "failures" / "0001.mp4")
    assert video.frames_srgb.shape == (figures["rollouts"][1]["frames"], 48, 128, 3)
    assert FILMED == 10
    with pytest.raises(ConfigError, match="was begun for something else"):
        evaluate(suite, toy, out, EvaluationRequest(policy="nearest_replay"), 1, silent)


def test_pictures_are_drawn_when_the_policy_looks(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, drawn = Still(), []
    from aomgen.evaluation.views import SplatViews

    monkeypatch.setattr(SplatViews, "draw", lambda self, reached: drawn.append(reached) or {})
    record = roll_out(world, policy, 0)
    assert record.fail_reason == "target"
    assert record.frames == world.suite.max_frames
    assert policy.looked == [frame % 2 == 0 for frame in range(record.frames)]
    assert len(drawn) == sum(policy.looked)
    # The object does not move, so the points stay where they were located.
    assert record.finder_mm == pytest.approx(np.full((len(drawn), 5), 3.0), abs=0.1)


def test_the_nearest_episode_is_replayed(world: World, toy: ToyResults) -> None:
    policy = open_policy("nearest_replay", world)
    assert isinstance(policy, NearestReplay)
    record = roll_out(world, policy, 0)
    assert record.frames > 10
    elsewhere = (
        open_policy(f"nearest_replay={toy.out}", world) if (toy.out / "project.toml").exists() else policy
    )
    again = roll_out(world, elsewhere, 0)
    assert again.figures == record.figures
    np.testing.assert_array_equal(again.ee_world, record.ee_world)
    np.testing.assert_array_equal(again.opening_shares, record.opening_shares)


def test_other_demonstrations_are_another_policy(world: World, toy: ToyResults) -> None:
    first = open_policy("nearest_replay", world).digest
    assert open_policy("nearest_replay", world).digest == first
    assert open_policy("oracle_replay", world).digest == ""
    path = toy.folders["episodes"] / "000000" / "episode.json"
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    try:
        assert open_policy("nearest_replay", world).digest not in ("", first)
    finally:
        path.write_bytes(content)


def test_policies_that_do_not_exist_are_refused(
    suite: Suite, toy: ToyResults, world: World, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="did you mean 'oracle_replay'"):
        evaluate(suite, toy, tmp_path / "out", EvaluationRequest(policy="oracle_repay"), 1, silent)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="is unknown"):
        open_policy("oracle_replay=7", world)
    with pytest.raises(MissingFileError):
        open_policy(f"nearest_replay={tmp_path}", world)


def test_images_of_several_sizes_are_joined() -> None:
    joined = place_side_by_side([np.full((2, 3, 3), 10, np.uint8), np.full((4, 1, 3), 20, np.uint8)])
    assert joined[..., 0].tolist() == [[10, 10, 10, 20]] * 2 + [[0, 0, 0, 20]] * 2


def test_wilsons_interval_is_the_textbooks() -> None:
    # Newcombe 1998, table I: 81 of 263.
    assert np.allclose(interval_95(81, 263), [0.2553, 0.3662], atol=1e-4)
    assert json.dumps(interval_95(0, 200))
