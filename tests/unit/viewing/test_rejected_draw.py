from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import Trajectory
from aomgen.core.plan import Rejection, Variation
from aomgen.viewing import rejected_draw
from aomgen.viewing.draw_list import Draw
from aomgen.viewing.rejected_draw import NOTE, PAIR, replan_draw
from toy_drawer import fitted_drawer

CAMERA = Camera(fx=80, fy=80, cx=40, cy=32, width=80, height=64, T_world_cam=look_at((1, 1, 1), (0, 0, 0)))
VARIATION = Variation(seed=0, index=3, x=0.1, y=0.0, yaw=0.2)
DRAW = Draw(number=3, asset="drawer-0", outcome="rejected", reason="collision", detail="is 3.0, limit 1.0")


def make_motion(frames: int, start: float) -> Trajectory:
    return Trajectory(
        times_s=np.arange(frames) / 10,
        joints=start + np.zeros((frames, 6)),
        gripper=np.zeros(frames),
        thetas=np.zeros(frames),
    )


@pytest.fixture
def results(robot, tmp_path) -> SimpleNamespace:
    return SimpleNamespace(
        robot=robot, demonstration=make_motion(9, 0.5), fps=10.0, folders={"episodes": tmp_path}
    )


def plan_as(monkeypatch, planned) -> None:
    """Let planning give a fixed result."""
    fitted = fitted_drawer()
    factory = SimpleNamespace(
        screen=lambda unit: (VARIATION, None),
        asset=lambda number: SimpleNamespace(sized=lambda scale: (fitted, None)),
        plan=lambda opened, variation: planned,
        place=SimpleNamespace(views=lambda variation, fitted: {"front": CAMERA}),
        params=SimpleNamespace(bolted=True),
    )
    monkeypatch.setattr(rejected_draw, "EpisodeFactory", lambda results, folder: factory)


def test_the_state_of_the_collision_is_shown(results, monkeypatch) -> None:
    plan_as(
        monkeypatch,
        Rejection(
            reason="collision",
            detail="is 3.0, limit 1.0 (wrist and door)",
            bodies=("wrist", "door"),
            worst=make_motion(1, 0.2),
        ),
    )
    shown = replan_draw(results, DRAW)
    np.testing.assert_allclose(shown.episode.joints, np.full((1, 6), 0.2))
    np.testing.assert_allclose(shown.episode.T_world_object, VARIATION.place_at(fitted_drawer()))
    assert shown.videos == {}
    assert shown.episode.verdict[PAIR] == ("wrist", "door")
    assert (
        "Sample 3 gave no episode: collision, is 3.0, limit 1.0. The page shows"
        in shown.episode.verdict[NOTE]
    )


def test_another_reason_than_the_stored_one_is_stated(results, monkeypatch) -> None:
    plan_as(monkeypatch, Rejection(reason="no_path", detail="there is none"))
    shown = replan_draw(results, DRAW)
    np.testing.assert_allclose(shown.episode.joints, np.full((1, 6), 0.5))
    assert shown.episode.verdict[PAIR] == ()
    note = shown.episode.verdict[NOTE]
    assert "planned again it gives no path, there is none. The state of the arm is not known" in note
