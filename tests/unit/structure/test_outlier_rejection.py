"""Misregistered images are found from two-view matches alone: single ones, groups, and repeated images."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.structure.outlier_rejection import (
    check_registration,
    duplicates,
    epipolar_errors_px,
    find_wrong_groups,
)
from aomgen.structure.sparse_model import Pair

COUNT = 24


def _world(seed: int) -> tuple[np.ndarray, dict[str, Camera], np.random.Generator]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 0], [1, 1, 0.8], (400, 3))
    cameras = {}
    for index in range(COUNT):
        angle = 2 * np.pi * index / COUNT
        eye = [3 * np.cos(angle), 3 * np.sin(angle), 1.5]
        cameras[f"{index:02d}.png"] = Camera(
            fx=500, fy=500, cx=320, cy=240, width=640, height=480, T_world_cam=look_at(eye, [0, 0, 0.3])
        )
    return points, cameras, rng


def _pair(a: str, b: str, cameras: dict[str, Camera], points: np.ndarray, rng: np.random.Generator) -> Pair:
    noise = rng.normal(0, 0.4, (2, len(points), 2))
    return Pair(
        a=a,
        b=b,
        pixels_a=cameras[a].project(points)[0] + noise[0],
        pixels_b=cameras[b].project(points)[0] + noise[1],
    )


def _pairs(points: np.ndarray, cameras: dict[str, Camera], rng: np.random.Generator) -> list[Pair]:
    """All pairs tried: neighbours on the ring share points, the others nothing."""
    names = list(cameras)
    pairs = []
    for i, a in enumerate(names):
        for j in range(i + 1, COUNT):
            apart = min(j - i, COUNT - j + i)
            shared = points[: max(0, 160 - 40 * (apart - 1))]
            pairs.append(_pair(a, names[j], cameras, shared, rng))
    return pairs


def _poses(cameras: dict[str, Camera], moved: set[str], T: np.ndarray) -> dict[str, np.ndarray]:
    return {name: (T if name in moved else np.eye(4)) @ c.T_world_cam for name, c in cameras.items()}


def _find(poses: dict[str, np.ndarray], cameras: dict[str, Camera], pairs: list[Pair]) -> list[set[str]]:
    return find_wrong_groups(poses, dict.fromkeys(poses, 3.3), next(iter(cameras.values())).K, pairs)


@pytest.mark.parametrize("seed", range(4))
def test_a_right_model_has_no_wrong_group(seed):
    points, cameras, rng = _world(seed)
    pairs = _pairs(points, cameras, rng)
    # Repeated prints: as many false matches as a true pair may have, between unrelated places.
    names = list(cameras)
    pairs += [
        Pair(
            a=names[i],
            b=names[(i + 11) % COUNT],
            pixels_a=rng.uniform(0, 480, (30, 2)),
            pixels_b=rng.uniform(0, 480, (30, 2)),
        )
        for i in range(11)
    ]
    assert _find(_poses(cameras, set(), np.eye(4)), cameras, pairs) == []


@pytest.mark.parametrize("size", [1, 4, 9])
@pytest.mark.parametrize("seed", range(3))
def test_a_group_that_is_wrong_as_a_whole_is_found(seed, size):
    points, cameras, rng = _world(seed)
    first = int(rng.integers(COUNT))
    names = list(cameras)
    group = {names[(first + i) % COUNT] for i in range(size)}
    T = transform(matrix_from_rotvec(rng.normal(0, 0.6, 3)), rng.normal(0, 1.0, 3))
    pairs = _pairs(points, cameras, rng)
    poses = _poses(cameras, group, T)
    found = _find(poses, cameras, pairs)
    assert found == [group]
    if size == 9:
        # Each image by itself is held up by its group.
        verdicts = check_registration(poses, next(iter(cameras.values())).K, pairs)
        dropped = {name for name, (_, reason) in verdicts.items() if reason}
        assert dropped != group


def test_the_far_side_of_a_carton_placed_at_its_front_is_found_by_what_is_missing():
    """No match contradicts: the two sides have no true match, only the print that misled the mapper."""
    points, cameras, rng = _world(7)
    names = list(cameras)
    group = set(names[12:19])
    half_turn = transform(matrix_from_rotvec([0, 0, np.pi + 0.05]), [0, 0, 0])
    poses = _poses(cameras, group, half_turn)
    shown = {name: cameras[name].move(poses[name]) for name in names}
    pairs = []
    for pair in _pairs(points, cameras, rng):
        if (pair.a in group) == (pair.b in group):
            pairs.append(pair)
        else:
            pairs.append(Pair(a=pair.a, b=pair.b, pixels_a=np.zeros((0, 2)), pixels_b=np.zeros((0, 2))))
    # The print fits the wrong place: forty matches between two images that stand side by side there.
    at = next(i for i, p in enumerate(pairs) if (p.a, p.b) == (names[2], names[14]))
    pairs[at] = _pair(names[2], names[14], shown, points[:40], rng)
    assert _find(poses, cameras, pairs) == [group]


def test_two_wrong_groups_are_both_found():
    points, cameras, rng = _world(3)
    names = list(cameras)
    one, two = set(names[2:6]), set(names[14:18])
    poses = _poses(cameras, one, transform(np.eye(3), [0, 0, 1.0]))
    other = _poses(cameras, two, transform(np.eye(3), [0.8, 0, -0.6]))
    poses |= {name: other[name] for name in two}
    found = _find(poses, cameras, _pairs(points, cameras, rng))
    assert set().union(*found) == one | two


def test_names_do_not_matter():
    points, cameras, rng = _world(5)
    group = set(list(cameras)[4:9])
    poses = _poses(cameras, group, transform(np.eye(3), [0, 0, 1.0]))
    pairs = _pairs(points, cameras, rng)
    new = dict(zip(cameras, rng.permutation([f"x{i:02d}" for i in range(COUNT)]), strict=True))
    renamed = {new[name]: T for name, T in poses.items()}
    swapped = [
        Pair(a=new[p.b], b=new[p.a], pixels_a=p.pixels_b, pixels_b=p.pixels_a) for p in reversed(pairs)
    ]
    assert _find(renamed, cameras, swapped) == [{new[name] for name in group}]


def test_a_repeated_image_is_found_and_the_prompted_one_stays():
    points, cameras, rng = _world(6)
    names = list(cameras)
    pairs = _pairs(points, cameras, rng)
    pixels = cameras[names[3]].project(points)[0]
    again = Pair(a=names[3], b="99.png", pixels_a=pixels, pixels_b=pixels + rng.normal(0, 0.2, pixels.shape))
    assert duplicates(pairs, set()) == {}
    assert duplicates([*pairs, again], set()) == {"99.png": names[3]}
    assert duplicates([*pairs, again], {"99.png"}) == {names[3]: "99.png"}


def test_of_three_equal_images_one_stays():
    pixels = np.random.default_rng(0).uniform(0, 480, (60, 2))
    pairs = [
        Pair(a=a, b=b, pixels_a=pixels, pixels_b=pixels) for a, b in (("a", "b"), ("a", "c"), ("b", "c"))
    ]
    assert duplicates(pairs, set()) == {"b": "a", "c": "a"}
    assert set(duplicates(pairs, {"c"})) == {"a", "b"}


def _arc(seed: int) -> tuple[np.ndarray, dict[str, Camera], np.random.Generator]:
    """Half of the ring."""
    points, cameras, rng = _world(seed)
    return points, dict(list(cameras.items())[:12]), rng


def _neighbours(points, cameras, rng, reach: int = 4) -> list[Pair]:
    names = list(cameras)
    return [
        _pair(a, b, cameras, points, rng) for i, a in enumerate(names) for b in names[i + 1 : i + 1 + reach]
    ]


def test_epipolar_error_is_zero_at_the_true_poses_and_grows_with_a_wrong_one():
    points, cameras, _ = _arc(0)
    a, b = cameras["00.png"], cameras["02.png"]
    pair = Pair(a="a", b="b", pixels_a=a.project(points)[0], pixels_b=b.project(points)[0])
    assert epipolar_errors_px(pair, a.T_world_cam, b.T_world_cam, a.K).max() < 1e-6
    moved = b.T_world_cam @ transform(np.eye(3), [0, 0.3, 0])
    assert np.median(epipolar_errors_px(pair, a.T_world_cam, moved, a.K)) > 10


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_images_a_metre_off_are_found_and_no_other(seed):
    points, cameras, rng = _arc(seed)
    pairs = _neighbours(points, cameras, rng)
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    wrong = set(rng.choice(list(poses), 2, replace=False))
    for name in wrong:
        step = rng.normal(size=3)
        poses[name] = transform(np.eye(3), step / np.linalg.norm(step)) @ poses[name]
    verdicts = check_registration(poses, next(iter(cameras.values())).K, pairs)
    assert {name for name, (_, reason) in verdicts.items() if reason} == wrong
    assert all("misregistered" in verdicts[name][1] for name in wrong)


def test_false_pairs_from_repeated_prints_do_not_outvote_true_neighbours():
    points, cameras, rng = _arc(4)
    pairs = _neighbours(points, cameras, rng, reach=2)
    names = list(cameras)
    for other in names[4:]:  # thirty matches between unrelated places, many times
        junk = rng.uniform([0, 0], [640, 480], (2, 30, 2))
        pairs.append(Pair(a=names[0], b=other, pixels_a=junk[0], pixels_b=junk[1]))
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    verdicts = check_registration(poses, cameras[names[0]].K, pairs)
    assert not any(reason for _, reason in verdicts.values())


def test_an_image_without_matches_is_not_accepted():
    points, cameras, rng = _arc(5)
    pairs = [pair for pair in _neighbours(points, cameras, rng) if "03.png" not in (pair.a, pair.b)]
    poses = {name: camera.T_world_cam for name, camera in cameras.items()}
    verdicts = check_registration(poses, cameras["00.png"].K, pairs)
    assert "no other image" in verdicts["03.png"][1]
