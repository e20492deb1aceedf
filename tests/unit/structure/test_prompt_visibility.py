"""Prompted places that the scan looked at pass; each way of not having looked is refused by name."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.recording import Prompt
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity
from aomgen.errors import ReconstructionError
from aomgen.structure.prompt_visibility import PromptVisibility, measure_prompt_visibility, require_coverage

PLACE = np.array([0.3, 0.1, 0.2])


def camera(angle_deg: float, aim: np.ndarray = PLACE) -> Camera:
    angle = np.radians(angle_deg)
    eye = PLACE + [2 * np.cos(angle), 2 * np.sin(angle), 0.0]
    return Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=look_at(eye, aim))


def scene(cameras: dict[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """A blob of points at the place, a wall far behind it, all observed by all."""
    rng = np.random.default_rng(0)
    blob = PLACE + rng.normal(0, 0.03, (40, 3))
    wall = np.stack([np.full(40, -8.0), rng.uniform(-4, 4, 40), rng.uniform(-3, 3, 40)], 1)
    points = np.concatenate([blob, wall])
    rows = [(point, index) for index in range(len(cameras)) for point in range(len(points))]
    return points, np.array(rows, np.int32)


def prompt(image: str, part: str = "moving", *, box: bool = False) -> Prompt:
    if box:
        return Prompt(part=part, image=image, points=np.zeros((0, 3)), box=np.array([140.0, 100, 180, 140]))
    return Prompt(part=part, image=image, points=np.array([[160.0, 120, 1], [20, 20, 0]]), box=np.zeros(0))


@pytest.mark.parametrize("box", [True, False])
def test_views_and_the_angle_between_them_are_counted(box):
    cameras = {f"{i}.jpg": camera(20.0 * i) for i in range(4)}
    cameras["away.jpg"] = camera(30.0, PLACE + [9.0, 9.0, 0.0])
    points, observations = scene(cameras)
    (found,) = measure_prompt_visibility((prompt("1.jpg", box=box),), cameras, points, observations)
    assert (found.part, found.image, found.registered, found.views) == ("moving", "1.jpg", True, 4)
    assert found.angle_deg == pytest.approx(60, abs=3)
    require_coverage([found])


@pytest.mark.parametrize("seed", range(5))
def test_scale_and_place_of_the_model_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    cameras = {f"{i}.jpg": camera(15.0 * i) for i in range(5)}
    points, observations = scene(cameras)
    (before,) = measure_prompt_visibility((prompt("2.jpg"),), cameras, points, observations)
    scale, R = 10 ** rng.uniform(-2, 2), matrix_from_rotvec(rng.normal(0, 2, 3))
    S = similarity(scale, R, rng.normal(0, 5, 3))
    moved = {}
    for name, item in cameras.items():
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R @ item.T_world_cam[:3, :3], apply(S, item.center)
        moved[name] = item.move(T)
    (after,) = measure_prompt_visibility((prompt("2.jpg"),), moved, apply(S, points), observations)
    assert after.views == before.views
    assert after.angle_deg == pytest.approx(before.angle_deg, abs=1e-6)


def test_a_prompted_image_without_points_has_no_place():
    cameras = {f"{i}.jpg": camera(20.0 * i) for i in range(4)}
    points, observations = scene(cameras)
    (found,) = measure_prompt_visibility(
        (prompt("1.jpg"),), cameras, points, observations[observations[:, 1] != 1]
    )
    assert (found.registered, found.views) == (True, 0)
    with pytest.raises(ReconstructionError, match="visible in 0 images"):
        require_coverage([found])


def test_an_image_that_is_not_in_the_model_is_refused_unless_another_one_is():
    cameras = {f"{i}.jpg": camera(20.0 * i) for i in range(4)}
    points, observations = scene(cameras)
    found = measure_prompt_visibility((prompt("lost.jpg"), prompt("1.jpg")), cameras, points, observations)
    require_coverage(found)
    with pytest.raises(ReconstructionError, match=r"moving part \(lost\.jpg\) could not be registered"):
        require_coverage(found[:1])


@pytest.mark.parametrize(
    ("views", "angle_deg", "problem"),
    [(2, 40.0, "2 images over 40 deg"), (9, 4.0, "9 images over 4 deg"), (9, float("nan"), "at least 3")],
)
def test_a_part_seen_too_rarely_or_from_one_side_is_refused(views, angle_deg, problem):
    good = PromptVisibility(part="robot", image="0.jpg", registered=True, views=9, angle_deg=90.0)
    poor = PromptVisibility(part="static", image="1.jpg", registered=True, views=views, angle_deg=angle_deg)
    require_coverage([good])
    with pytest.raises(ReconstructionError, match=f"static part.*{problem}"):
        require_coverage([good, poor])


def test_the_best_of_a_parts_prompts_counts():
    poor = PromptVisibility(part="static", image="1.jpg", registered=True, views=2, angle_deg=80.0)
    good = PromptVisibility(part="static", image="2.jpg", registered=True, views=5, angle_deg=30.0)
    require_coverage([poor, good])


def test_nothing_prompted_is_fine():
    require_coverage(measure_prompt_visibility((), {}, np.zeros((0, 3)), np.zeros((0, 2), np.int32)))
