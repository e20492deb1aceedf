"""The demonstration is transferred to a drawer of which only the keypoints in images are known."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import EpisodePlan, Rejection, Variation
from aomgen.core.transforms import apply
from aomgen.episodes.keypoint_fit import stretch
from aomgen.episodes.keypoint_planner import KeypointPlanner
from aomgen.episodes.retarget import CONTACT
from toy_run import ToyResults, toy_run


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> ToyResults:
    return toy_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    eyes = ((0.2, 0.9, 0.9), (0.2, -1.1, 0.8), (0.1, -0.2, 0.9))
    return [
        Camera(
            fx=230, fy=230, cx=120, cy=120, width=240, height=240, T_world_cam=look_at(eye, (0.8, -0.2, 0.2))
        )
        for eye in eyes
    ]


def detect(cameras: list[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    return pixels, np.full(pixels.shape[:2], 1.0), points


def test_the_gripper_takes_the_handle_of_a_stretched_drawer(
    results: ToyResults, cameras: list[Camera]
) -> None:
    drawer = stretch(results.fitted_assets[0], np.array([1.05, 1.0, 1.04]))
    T = Variation(seed=0, index=0, x=0.02, y=0.03, yaw=0.15).place_at(drawer)
    points = apply(T, find_keypoints(drawer.asset))
    joints = results.demonstration.joints[0] + 0.02
    plan = KeypointPlanner(results, results.fitted_assets, None).plan(
        cameras, *detect(cameras, points), joints
    )
    assert isinstance(plan, EpisodePlan), plan
    np.testing.assert_allclose(plan.joints[0], joints, atol=1e-6)
    # The fingertips are up to one centimeter behind the bar.
    closed = plan.Ts_world_ee[np.argmax(plan.phases == CONTACT)]
    assert np.linalg.norm(closed[:3, 3] - points[0]) < 0.025
    pulled = plan.Ts_world_ee[plan.phases == CONTACT][-1, :3, 3] - closed[:3, 3]
    np.testing.assert_allclose(pulled, -plan.thetas[-1] * T[:3, 1], atol=0.01)


def test_an_object_beyond_the_reach_is_rejected(results: ToyResults, cameras: list[Camera]) -> None:
    fitted = results.fitted_assets[0]
    far = Variation(seed=0, index=0, x=0.8, y=0.0, yaw=0.0).place_at(fitted)
    points = apply(far, find_keypoints(fitted.asset))
    found = KeypointPlanner(results, results.fitted_assets, None).plan(
        cameras, *detect(cameras, points), results.demonstration.joints[0]
    )
    assert isinstance(found, Rejection)
    assert found.reason == "unreachable"


def test_an_object_that_faces_away_has_no_plan(results: ToyResults, cameras: list[Camera]) -> None:
    fitted = results.fitted_assets[0]
    turned = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=np.pi).place_at(fitted)
    points = apply(turned, find_keypoints(fitted.asset))
    found = KeypointPlanner(results, results.fitted_assets, None).plan(
        cameras, *detect(cameras, points), results.demonstration.joints[0]
    )
    assert isinstance(found, Rejection)
    assert found.reason == "no_object"
