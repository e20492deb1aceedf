"""Misregistered images are found from two-view matches alone."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import transform
from aomgen.structure.misregistration import Pair, check_registration, epipolar_errors_px


def _world(seed: int, views: int = 12):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 0], [1, 1, 0.8], (400, 3))
    cameras = {}
    for index in range(views):
        angle = 0.25 * index
        eye = [3 * np.cos(angle), 3 * np.sin(angle), 1.5]
        cameras[f"{index:02d}.png"] = Camera(
            fx=500, fy=500, cx=320, cy=240, width=640, height=480, T_world_cam=look_at(eye, [0, 0, 0.3])
        )
    return points, cameras, rng


def _pairs(points, cameras, rng, reach: int = 4) -> list[Pair]:
    names = list(cameras)
    pairs = []
    for i, a in enumerate(names):
        for b in names[i + 1 : i + 1 + reach]:
            noise = rng.normal(0, 0.4, (2, len(points), 2))
            pairs.append(
                Pair(
                    a=a,
                    b=b,
                    pixels_a=cameras[a].project(points)[0] + noise[0],
                    pixels_b=cameras[b].project(points)[0] + noise[1],
                )
            )
    return pairs


def test_epipolar_error_is_zero_at_the_true_poses_and_grows_with_a_wrong_one():
    points, cameras, _ = _world(0)
    a, b = cameras["00.png"], cameras["02.png"]
    pair = Pair(a="a", b="b", pixels_a=a.project(points)[0], pixels_b=b.project(points)[0])
    assert epipolar_errors_px(pair, a.T_world_cam, b.T_world_cam, a.K).max() < 1e-6
    moved = b.T_world_cam @ transform(np.eye(3), [0, 0.3, 0])
    assert np.median(epipolar_errors_px(pair, a.T_world_cam, moved, a.K)) > 10


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_images_a_metre_off_are_found_and_no_other(seed):
    points, cameras, rng = _world(seed)
    pairs = _pairs(points, cameras, rng)
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    wrong = set(rng.choice(list(poses), 2, replace=False))
    for name in wrong:
        step = rng.normal(size=3)
        poses[name] = transform(np.eye(3), step / np.linalg.norm(step)) @ poses[name]
    verdicts = check_registration(poses, next(iter(cameras.values())).K, pairs)
    assert {name for name, verdict in verdicts.items() if not verdict.accepted} == wrong
    assert all("misregistered" in verdicts[name].reason for name in wrong)


def test_false_pairs_from_repeated_prints_do_not_outvote_true_neighbours():
    points, cameras, rng = _world(4)
    pairs = _pairs(points, cameras, rng, reach=2)
    names = list(cameras)
    for other in names[4:]:  # thirty matches between unrelated places, many times
        junk = rng.uniform([0, 0], [640, 480], (2, 30, 2))
        pairs.append(Pair(a=names[0], b=other, pixels_a=junk[0], pixels_b=junk[1]))
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    verdicts = check_registration(poses, cameras[names[0]].K, pairs)
    assert all(verdict.accepted for verdict in verdicts.values())


def test_an_image_without_matches_is_not_accepted():
    points, cameras, rng = _world(5)
    pairs = [pair for pair in _pairs(points, cameras, rng) if "03.png" not in (pair.a, pair.b)]
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    verdicts = check_registration(poses, cameras["00.png"].K, pairs)
    assert not verdicts["03.png"].accepted
    assert "no other image" in verdicts["03.png"].reason
