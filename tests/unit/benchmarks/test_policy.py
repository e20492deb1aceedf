"""The bench of trained policies counts rightly, and makes what is missing once."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aomgen.core.camera import Camera
from aomgen.episodes.factory import GenerationParams
from aomgen.errors import BackendError, ConfigError
from aomgen.io.schema import override
from benchmarks.policy import (
    QUICK_CELLS,
    TABLES,
    PolicyBench,
    Row,
    Training,
    beats,
    chosen_tables,
    table_figures,
)
from benchmarks.policy_data import WORLDS, Trials, moved_cameras


def tried(successes: list[bool]) -> dict[str, Any]:
    rollouts = [{"fail_reason": "" if success else "target"} for success in successes]
    return {
        "trials": len(successes),
        "successes": sum(successes),
        "success_rate": sum(successes) / len(successes),
        "rollouts": rollouts,
        **dict.fromkeys(("suite", "redrawn", "nearest_mm", "nearest_deg", "failures")),
    }


def test_more_successes_in_the_same_trials_must_not_be_chance() -> None:
    none, all_of_them = tried([False] * 10), tried([True] * 10)
    assert beats(all_of_them, none)
    assert not beats(none, all_of_them)
    # Five to none: two-sided p is 0.0625.
    assert not beats(tried([True] * 5 + [False] * 5), none)
    assert beats(tried([True] * 6 + [False] * 4), none)
    # Trials that both do count nothing, however many they are.
    assert not beats(tried([True] * 100 + [True] * 3), tried([True] * 100 + [False] * 3))
    assert not beats(all_of_them, all_of_them)


def test_seeds_are_counted_together_and_others_only_in_the_same_trials() -> None:
    here, there = Trials(world="microwave"), Trials(world="microwave", scale=0.6)
    policies = (Training(world="microwave", seed=3), Training(world="microwave", seed=4))
    rows = [
        (
            Row(label={"name": "learned"}, policies=policies, test=here),
            [tried([True] * 10), tried([False] * 10)],
        ),
        (Row(label={"name": "floor"}, policies=("nearest_replay",), test=here), [tried([False] * 10)]),
        (Row(label={"name": "elsewhere"}, policies=("nearest_replay",), test=there), [tried([False] * 10)]),
    ]
    learned, floor, _ = table_figures(iter(rows))
    assert (learned["name"], learned["trials"], learned["success_rate"]) == ("learned", 20, 0.5)
    assert (learned["seeds"], learned["by_seed"]) == ([3, 4], [1.0, 0.0])
    assert learned["beats"] == [{"name": "floor"}]
    assert (floor["seeds"], floor["beats"]) == ([], [])
    assert learned["interval_95"][0] < 0.5 < learned["interval_95"][1]


def test_tables_are_chosen_by_the_beginning_of_their_names() -> None:
    assert list(chosen_tables(["curve"])) == ["curve.microwave", "curve.drawer"]
    assert set(chosen_tables([])) == TABLES.keys() - set(QUICK_CELLS)
    with pytest.raises(ConfigError, match=r"'curv\.x' is unknown"):
        chosen_tables(["curv.x"])


def test_worlds_ask_for_ranges_that_a_project_understands() -> None:
    for world in WORLDS.values():
        found = override(GenerationParams(), {"ranges": dict(world.ranges)}, "episodes").ranges
        assert (found != GenerationParams().ranges) == bool(world.ranges)


def test_every_cell_has_its_worlds() -> None:
    for rows in TABLES.values():
        for row in rows:
            assert row.test.world in WORLDS
            for policy in row.policies:
                assert isinstance(policy, str) or WORLDS[policy.world].demonstrations > 0
                assert isinstance(policy, str) or policy.demonstrations <= WORLDS[policy.world].demonstrations
    assert not {"microwave:1"} & set(WORLDS["unseen_microwaves"].assets)
    assert not set(WORLDS["microwaves"].assets) & set(WORLDS["unseen_microwaves"].assets)


def test_cameras_move_by_the_asked_way_the_same_way_for_all_lengths() -> None:
    cameras = {
        name: Camera(width=4, height=4, fx=1.0, fy=1.0, cx=2.0, cy=2.0, T_world_cam=np.eye(4))
        for name in ("front", "side")
    }
    near, far = moved_cameras(cameras, 0.05), moved_cameras(cameras, 0.10)
    for name, camera in cameras.items():
        ways = [m[name].T_world_cam[:3, 3] - camera.T_world_cam[:3, 3] for m in (near, far)]
        assert np.linalg.norm(ways[0]) == pytest.approx(0.05)
        np.testing.assert_allclose(2 * ways[0], ways[1])
        np.testing.assert_array_equal(near[name].T_world_cam[:3, :3], np.eye(3))
    assert not np.allclose(near["front"].T_world_cam, near["side"].T_world_cam)


def test_without_lerobot_nothing_is_begun(tmp_path: Path) -> None:
    bench = PolicyBench(data=SimpleNamespace(folder=tmp_path), lerobot_train=tmp_path / "absent")  # type: ignore[arg-type]
    with pytest.raises(BackendError, match="make policy-env"):
        bench.figures(chosen_tables(QUICK_CELLS))
    assert list(tmp_path.iterdir()) == []
