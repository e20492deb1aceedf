"""The report's lists of episodes and rejects: short, linked, with what each figure is held against."""

import inspect
import json
import re
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aomgen.core.plan import Variation
from aomgen.core.project import Project
from aomgen.episodes.reach_map import front_line
from aomgen.errors import MalformedFileError
from aomgen.io.episode_folder import commit_episode
from aomgen.io.video import encode_video, read_frames
from aomgen.pipeline.stages import STAGES
from aomgen.report import episodes
from aomgen.report.episodes import episodes_section, place_words, reasons, rejects_section
from aomgen.report.page import provenance_table
from aomgen.results import Results
from aomgen.simulation.judge import judge
from aomgen.simulation.replay import simulate
from aomgen.simulation.verify import verify_plan
from drawer_episode import corner_camera, drawer_episode
from toy_drawer import fitted_drawer

FRAMES, SIZE = 6, (64, 48)
OUTCOME = {
    "name": "nominal", "damping": 4.0, "frictionloss": 2.0, "final_theta": 0.2, "target_share": 0.99,
    "contact_share": 0.95, "peak_force_n": 101.6, "peak_reaction_n": 12.2, "tracking_mm": 1.25,
    "torque_share": 0.41, "handle_penetration_mm": 0.34, "robot_force_n": 0.0,
}  # fmt: skip
VARIATION = {"seed": 0, "index": 1, "x": 0.021, "y": -0.001, "yaw": 0.35}


@pytest.fixture(scope="module")
def video() -> bytes:
    """Frames that become brighter, so that a poster tells which it is."""
    frames = [np.full((SIZE[1], SIZE[0], 3), 40 * number, np.uint8) for number in range(FRAMES)]
    return encode_video(frames, 10)


@pytest.fixture
def results(tmp_path: Path) -> Results:
    (tmp_path / "07_replacement" / "assets").mkdir(parents=True)
    folders = {stage.name: tmp_path / stage.folder for stage in STAGES}
    return Results(project=Project(capture=tmp_path, out=tmp_path, seed=5), out=tmp_path, folders=folders)


def commit(results: Results, count: int, video: bytes) -> None:
    """Episodes that are fully open in their fourth frame."""
    camera = corner_camera(*SIZE)
    cameras = {"front": camera, "side": camera}
    thetas = np.array([0, 0.1, 0.15, 0.2, 0.19, 0.19])
    verdict = {
        "bolted": True,
        "grasp": "tilt +0",
        "variation": VARIATION,
        "dynamic": [OUTCOME, {**OUTCOME, "tracking_mm": 2.0}],
    }
    for index in range(count):
        episode = drawer_episode(index, np.zeros((FRAMES, 6)), thetas, cameras, verdict, {})
        commit_episode(results.folders["episodes"], episode, {"front": video, "side": video})


def test_the_frames_asked_for_are_read(tmp_path: Path, video: bytes) -> None:
    path = tmp_path / "front.mp4"
    path.write_bytes(video)
    third, first = read_frames(path, [3, 1])
    assert (third.mean(), first.mean()) == (pytest.approx(120, abs=4), pytest.approx(40, abs=4))
    with pytest.raises(MalformedFileError, match="no frame 99"):
        read_frames(path, [99])


def test_both_cameras_play_side_by_side_and_load_nothing_before(results: Results, video: bytes) -> None:
    commit(results, 1, video)
    page = "".join(episodes_section(results))
    (card,) = re.findall(r"<figure class=.card.>.*?</figure>", page)
    assert re.findall(r' src="([^"]+)"', card) == [
        "08_episodes/000000/front.mp4",
        "08_episodes/000000/side.mp4",
    ]
    assert card.count('preload="none"') == 2
    assert card.count('poster="data:image/jpeg;base64,') == 2
    assert "opened 200 mm" in card
    assert "+2 cm, +0 cm, +20 deg" in card


def test_a_position_in_the_world_is_not_shown_as_a_displacement() -> None:
    place = {"x": 0.62, "y": -0.13, "yaw": 0.0}
    assert place_words({**place, "frame": "polygon"}) == "at 62 cm, -13 cm, +0 deg"
    for stored in (place, {**place, "frame": "world"}, {**place, "frame": "object"}):
        assert place_words(stored) == "+62 cm, -13 cm, +0 deg"


def test_the_verdicts_show_the_worst_setting_and_the_limits(results: Results, video: bytes) -> None:
    commit(results, 1, video)
    page = "".join(episodes_section(results))
    row = re.findall(r'<td class="n">([^<]+)</td>', page)
    assert row == ["99.0", "95.0", "2.0", "41", "0.3", "0", "102", "12"]
    assert "at least 90% of the planned travel" in page
    assert "The grip force has no separate limit" in page
    assert "because the object is simulated as fixed to the table" in page


def test_many_episodes_are_listed_and_only_the_first_decoded(
    results: Results, video: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit(results, 30, video)
    decoded = []
    monkeypatch.setattr(
        episodes, "read_frames", lambda path, _: decoded.append(path) or [np.zeros((48, 64, 3), np.uint8)]
    )
    page = "".join(episodes_section(results))
    assert len(decoded) == 48
    assert page.count("<video") == 48
    assert page.count('href="08_episodes/') == 60
    assert "The first 24 of 30 are shown" in page
    assert "<details><summary>all 30 episodes" in page


def test_the_map_shows_objects_at_their_size() -> None:
    fitted = fitted_drawer()
    there = Variation(seed=0, index=0, x=0.1, y=0.0, yaw=0.3, scale=0.6)
    results: Any = SimpleNamespace(fitted_assets=[fitted])
    shown = episodes._line(results, {"asset": 0, "variation": asdict(there), "outcome": "committed"})
    expected = front_line(fitted, there, "committed")
    np.testing.assert_array_equal(shown.points_world, expected.points_world)


def test_rejects_are_grouped_by_reason_with_pair_and_limit(results: Results) -> None:
    detail = "penetration_mm is 52.0, limit 1.0 (gripper_base and object_moving_door)"
    collision = {
        "name": "drawer-1",
        "outcome": "rejected",
        "reason": "collision",
        "detail": detail,
        "variation": VARIATION,
    }
    missed = {**collision, "reason": "unreachable", "detail": "7.8 mm and 0.8 deg from the requested pose"}
    hidden = {**collision, "outcome": "skipped", "reason": "out_of_view", "detail": "camera front shows 40 %"}
    good = {**collision, "outcome": "committed", "reason": "", "detail": ""}
    results.folders["episodes"].mkdir()
    draws = {"draws": [good, missed, hidden, *([collision] * 25)]}
    (results.folders["episodes"] / "draws.json").write_text(json.dumps(draws))
    page = "".join(rejects_section(results))
    assert re.findall(r"<h3>([^<]+)</h3>", page) == [
        "25 collision: robot and scene overlap by more than 1 mm",
        "1 unreachable: the arm misses a requested pose by more than 1 mm or 0.5 deg",
        "1 out of view: a camera does not show enough of the action",
    ]
    assert page.count(detail) == 20
    assert "5 more in 08_episodes/draws.json" in page


def test_every_reason_of_planning_is_explained() -> None:
    from aomgen.episodes.rejections import REASONS

    assert set(REASONS) <= set(reasons())


def test_every_reason_of_verification_is_explained() -> None:
    source = [inspect.getsource(judge), inspect.getsource(verify_plan), inspect.getsource(simulate)]
    named = re.findall(r'(?:check\(|reason=)"(\w+)"', "".join(source))
    assert len(set(named)) >= 12
    assert set(named) <= set(reasons())


def test_the_head_says_what_made_the_run_or_that_nobody_knows(results: Results) -> None:
    assert provenance_table(results).count("not recorded") == 2
    record = {"command": "aomgen demo 'my out'", "version": "9.9", "finished": "2030-01-02T03:04:05+01:00"}
    (results.out / "run.json").write_text(json.dumps(record))
    table = provenance_table(results)
    for words in (
        "9.9",
        "2030-01-02 03:04:05+01:00",
        "aomgen demo &#x27;my out&#x27;",
        ">5<",
        "project.toml",
    ):
        assert words in table
