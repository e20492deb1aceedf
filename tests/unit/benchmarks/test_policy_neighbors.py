"""A neighbor stands on the table beside the tested object, is visible, and is an obstacle."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND
from aomgen.errors import NotEnoughEpisodesError
from aomgen.io.artifact import load_artifact
from aomgen.twin.twin import TwinModel
from benchmarks import policy_neighbors
from benchmarks.policy_neighbors import add_neighbor, measure_hidden_share
from toy_run import ToyResults, toy_run


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ToyResults:
    made = toy_run(tmp_path / "run")
    monkeypatch.setattr(policy_neighbors, "open_results", lambda run: made)
    return made


def test_a_neighbor_is_seen_and_can_be_touched(results: ToyResults) -> None:
    scene, before = results.episode_scene, load_artifact(results.asset_folder(0), "twin", TwinModel)
    add_neighbor(results.out, "toolbox:22")
    after = load_artifact(results.asset_folder(0), "twin", TwinModel)
    added = slice(len(before.gaussians), None)
    assert set(after.bodies[added]) == {0}
    assert set(after.labels[added]) == {BACKGROUND}
    means = after.gaussians.means[added]
    camera = scene.cameras["front"]
    pixels, depths = camera.project(means.astype(np.float64))
    inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    assert inside.mean() > 0.8
    assert means[:, 2].min() == pytest.approx(scene.support.height, abs=0.01)
    del results.__dict__["episode_scene"]
    boxes = results.episode_scene.obstacles[len(scene.obstacles) :]
    corners = np.concatenate([box.corners() for box in boxes])
    # Collision boxes and discs are those of one object.
    np.testing.assert_allclose(corners.min(0), means.min(0), atol=0.03)
    np.testing.assert_allclose(corners.max(0), means.max(0), atol=0.03)


def test_a_scene_without_room_is_refused(results: ToyResults, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_neighbors, "OFFSET_M", 0.01)
    with pytest.raises(NotEnoughEpisodesError, match="no room"):
        add_neighbor(results.out, "toolbox:22")


def test_what_is_nearer_to_the_camera_hides_what_is_behind(results: ToyResults) -> None:
    camera = results.episode_scene.cameras["front"]
    ahead = camera.T_world_cam[:3, 2]

    def square(distance_m: float, aside_m: float) -> np.ndarray:
        sides = np.array([[x, y] for x in (-0.1, 0.1) for y in (-0.1, 0.1)]) * distance_m + [aside_m, 0]
        return camera.center + distance_m * ahead + sides @ camera.T_world_cam[:3, :2].T

    target = square(1.0, 0.0)
    assert measure_hidden_share(camera, target, square(0.5, 0.0)) == pytest.approx(1.0)
    assert measure_hidden_share(camera, target, square(2.0, 0.0)) == 0.0
    assert measure_hidden_share(camera, target, square(0.5, 0.05)) == pytest.approx(0.5)
    assert measure_hidden_share(camera, target, square(0.5, 0.2)) == 0.0
