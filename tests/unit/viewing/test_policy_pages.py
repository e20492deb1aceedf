from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera
from aomgen.core.verdict import Setting
from aomgen.evaluation.evaluate import RolloutRecord
from aomgen.evaluation.suite import Suite, Trial, write_suite
from aomgen.io.artifact import save_artifact
from aomgen.io.atomic import write_bytes, write_json
from aomgen.viewing.policy_pages import PolicyRoutes, find_evaluations, find_suites, first_difference
from aomgen.web.page_server import PageRequest
from reviewed_run import make_variation

FPS, FRAMES = 10, 20


def make_record(
    trial: int, *, reason: str = "", turned_at: int = FRAMES, frames: int = FRAMES
) -> RolloutRecord:
    """A rollout that opens the object evenly; from one frame on the end effector is 5 cm off."""
    ee = np.zeros((frames, 3))
    ee[:, 0] = np.linspace(0, 0.2, frames)
    ee[turned_at:, 1] = 0.05
    shares = np.linspace(0, 0.95, frames)
    return RolloutRecord(
        trial=trial, fail_reason=reason, opening_share=0.95, frames=frames, touched_obstacle=False,
        opening_shares=shares, ee_world=ee,
    )  # fmt: skip


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A run with a suite beside it, which two policies have tried; another run's suite is there, too."""
    out = tmp_path / "run"
    out.mkdir()
    camera = Camera(fx=80.0, fy=80.0, cx=40.0, cy=32.0, width=80, height=64, T_world_cam=np.eye(4))
    setting = Setting(name="nominal", damping=1.0, frictionloss=1.0, moving_mass=1.0)
    trials = [Trial(asset=0, variation=make_variation(k), setting=setting, joints=np.zeros(6), gripper=0.0) for k in range(3)]  # fmt: skip
    suite = Suite(
        run="run", twin="t", task="open it", assets=("microwave-1",), joint_names=("a",) * 6, fps=FPS,
        action_space="joint", cameras={"front": camera}, drawn_size=(80, 64), max_frames=FRAMES, seed=1,
        trials=tuple(trials), redrawn={}, nearest=None,
    ).seal()  # fmt: skip
    write_suite(tmp_path / "suite.json", suite)
    write_json(tmp_path / "notes.json", {"type": "notes"})
    records = {
        "first": [make_record(0), make_record(1, reason="target"), make_record(2)],
        "second": [make_record(0), make_record(1, turned_at=7), make_record(2, turned_at=12)],
    }
    for policy, made in records.items():
        folder = tmp_path / f"suite-{policy}"
        request = {
            "suite": suite.digest,
            "policy": policy,
            "visuals": "splat",
            "action_space": None,
            "weights": "",
        }
        write_json(folder / "rollouts" / "request.json", request)
        for record in made:
            save_artifact(folder / "rollouts", f"{record.trial:04d}", record)
    write_bytes(tmp_path / "suite-first" / "failures" / "0001.mp4", b"video")
    write_json(tmp_path / "other" / "rollouts" / "request.json", {"suite": "another"})
    return out


def test_policies_of_a_suite_are_compared_by_trial(out: Path) -> None:
    (out.parent / "damaged.json").write_text('{"type": "Suite"')
    suites, problems = find_suites(out)
    assert [path.name for path, _ in suites] == ["suite.json"]
    assert ["damaged.json" in problem for problem in problems] == [True]
    assert find_suites(out.parent / "elsewhere")[0] == []
    pages = PolicyRoutes(out).list_routes()

    def ask(path: str, **query: object) -> bytes:
        return pages[f"GET /policies/{path}"](
            PageRequest({key: str(value) for key, value in query.items()}, b"")
        ).content

    assert b'"policies": 2' in ask("suites")
    assert b'"failures": {"target": 1}' in ask("suite", suite=0)
    assert b'"differs": {"frame": 7' in ask("trial", suite=0, trial=1, first=0, second=1)
    assert b'"differs": null' in ask("trial", suite=0, trial=0, first=0, second=1)
    assert ask("video", suite=0, policy=0, trial=1) == b"video"
    for query in ({"policy": 1, "trial": 1}, {"policy": 9, "trial": 1}, {"policy": 0, "trial": 0}):
        with pytest.raises(ValueError):
            ask("video", suite=0, **query)


def test_the_first_difference_is_that_of_paths_openings_or_outcomes() -> None:
    assert first_difference(make_record(0), make_record(0)) is None
    assert first_difference(make_record(0), make_record(0, turned_at=7)) == {
        "frame": 7,
        "mm": 50.0,
        "opening": 0.0,
    }
    found = first_difference(make_record(0), make_record(0, reason="torque"))
    assert found == {"frame": FRAMES - 1, "mm": 0.0, "opening": 0.0}
    shorter = first_difference(make_record(0), make_record(0, frames=10))
    assert shorter is not None
    assert shorter["frame"] > 0


def test_unfinished_evaluations_are_shown(out: Path) -> None:
    (out.parent / "suite-second" / "rollouts" / "0002.json").unlink()
    path, suite = find_suites(out)[0][0]
    assert [len(records) for _, _, records in find_evaluations(path, suite)] == [3, 2]
