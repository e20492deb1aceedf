"""Whether a part moved at all, and whether it is the prompted one."""

from dataclasses import replace

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.values import Array
from aomgen.errors import NoMotionError, WrongPromptError
from aomgen.motion.inputs import GripperSignals
from aomgen.motion.motion_detection import (
    MIN_ODDS,
    CandidateEvidence,
    MotionEvidence,
    PartIdentification,
    estimate_following,
    find_visible_regions,
    identify_part,
    list_warnings,
)
from aomgen.splatting.rasterizer import render

# Share by which the part follows, and its standard deviation, where nothing is visible.
BLIND = 0.0, float("inf")
CAMERA = Camera(
    fx=100, fy=100, cx=48, cy=32, width=96, height=64, T_world_cam=look_at([0, -1.0, 0], [0, 0, 0])
)


def signs(
    changed: float, following: tuple[float, float] = BLIND, *, near: float = 0.0, travel: float = 0.2
) -> MotionEvidence:
    share, sd = following
    return MotionEvidence(changed=changed, followed=share, followed_sd=sd, nearest_m=near, travel_m=travel)


@pytest.mark.parametrize(
    ("changed", "share", "moved"),
    [(0.4, 0.8, True), (0.02, 0.9, True), (0.0, 0.0, False), (0.1, 0.0, False), (0.4, 0.4, True), (0.2, -0.1, False)],
)  # fmt: skip
def test_change_and_following_are_weighed_together(changed: float, share: float, moved: bool) -> None:
    assert (signs(changed, (share, 0.01)).log_likelihood_ratio > 0) == moved


def test_what_cannot_be_seen_says_nothing() -> None:
    assert signs(0.3).log_likelihood_ratio == pytest.approx(3.0)
    assert signs(0.3, (0.0, 1e6)).log_likelihood_ratio == pytest.approx(3.0)


def test_a_hand_that_only_closes_does_not_pull() -> None:
    assert signs(0.01, (0.9, 0.02), travel=0.002).log_likelihood_ratio < 0


def test_a_video_that_fits_a_resting_part_better_outweighs_a_change() -> None:
    """The arm's shadow changed the part, and changed with the gripper; the recovered motion does not fit."""
    shadowed = signs(0.35, (0.17, 0.001))
    shadowed.check()
    with pytest.raises(NoMotionError, match="fits a part at rest better than the recovered motion"):
        replace(shadowed, video_margin=-45.0).check()
    replace(shadowed, video_margin=20.0).check()


def test_refusals_name_their_reason() -> None:
    with pytest.raises(
        NoMotionError, match="the gripper never touches the part: its distance is at least 25 cm"
    ):
        signs(0.5, near=0.25).check()
    locked = signs(0.03, (0.02, 0.01), travel=0.3)
    with pytest.raises(
        NoMotionError, match=r"the gripper moves 300 mm .* follows by 2 % .* 3 % of its pixels"
    ):
        locked.check()
    signs(0.4, (0.8, 0.01)).check()


def board(middle: tuple[float, float, float], half: float, seed: int) -> Gaussians:
    """A patterned board across the view."""
    rng = np.random.default_rng(seed)
    count = 1200
    means = np.array(middle) + rng.uniform(-1, 1, (count, 3)) * [half, 0.0, half]
    colors = np.where(rng.random((count, 1)) < 0.5, 0.2, 0.8) * np.ones((1, 3))
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.012),
        opacities=np.full(count, 0.95),
        sh=((colors - 0.5) / SH_C0)[:, None],
    )


def scene() -> tuple[Gaussians, np.ndarray]:
    parts = [board((0.0, 0.0, 0.0), 0.12, 0), board((0.0, 0.3, 0.0), 0.6, 1)]
    return concatenate(parts), np.repeat([MOVING, STATIC], [1200, 1200]).astype(np.uint8)


def filmed(offsets: Array, shadow: bool = False) -> np.ndarray:
    gaussians, labels = scene()
    frames = []
    for k, offset in enumerate(offsets):
        T = np.eye(4)
        T[0, 3] = offset
        moved = concatenate(
            [gaussians.select(labels == MOVING).transform(T), gaussians.select(labels == STATIC)]
        )
        image = 255 * render(moved, CAMERA).rgb
        if shadow:
            image[:, 40 : 44 + k] *= 0.6
        frames.append(np.clip(image, 0, 255).astype(np.uint8))
    return np.stack(frames)


def pulled(offsets: Array) -> Array:
    Ts = np.repeat(np.eye(4)[None], len(offsets), 0)
    Ts[:, 0, 3] = offsets
    return Ts


@pytest.mark.parametrize("way_m", [0.005, 0.02, 0.1])  # half a pixel, two pixels, ten
def test_a_part_that_follows_is_told_from_one_that_stands(way_m: float) -> None:
    way = np.linspace(0, way_m, 8, dtype=np.float64)
    hidden = np.zeros((8, 64, 96), bool)
    moved = estimate_following(*scene(), CAMERA, filmed(way), hidden, pulled(way))
    stood = estimate_following(*scene(), CAMERA, filmed(0 * way, shadow=True), hidden, pulled(way))
    assert moved[0] == pytest.approx(1.0, abs=0.15)
    assert abs(stood[0]) < 0.35
    assert signs(0.01, moved).log_likelihood_ratio > 0 > signs(0.05, stood).log_likelihood_ratio


COUNT, FPS = 60, 15.0
TIMES = np.arange(COUNT) / FPS
# Looks along world x: columns are -y, rows are -z.
LEVEL = Camera(
    fx=100.0, fy=100.0, cx=80.0, cy=60.0, width=160, height=120,
    T_world_cam=np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
)  # fmt: skip
GRASP, RELEASE = 15, 50


def wall(columns: tuple[int, int], rows: tuple[int, int], depth: float = 1.0) -> Array:
    """Points of an upright rectangle that covers these pixels."""
    u, v = np.meshgrid(np.arange(*columns) + 0.5, np.arange(*rows) + 0.5)
    return np.column_stack(
        [np.full(u.size, depth), depth * (80 - u.ravel()) / 100, depth * (60 - v.ravel()) / 100]
    )


def parts_scene(*parts: Array) -> tuple[Gaussians, Array]:
    """Round Gaussians, about a pixel wide, at the points of the moving part, the static part, and the rest."""
    means = np.concatenate(parts)
    gaussians = gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=np.full((len(means), 3), 0.004),
        opacities=np.full(len(means), 0.99),
        sh=np.zeros((len(means), 1, 3)),
    )
    return gaussians, np.repeat([MOVING, STATIC, BACKGROUND][: len(parts)], [len(part) for part in parts])


DOOR, BODY, BOOKS = wall((30, 60), (40, 80)), wall((60, 120), (30, 90)), wall((125, 150), (70, 90))


def film(changing: list[tuple[slice, slice]], seed: int = 0) -> np.ndarray:
    """Frames (T, H, W, 3) in which areas turn bright while the hand holds on."""
    rng = np.random.default_rng(seed)
    frames = np.full((COUNT, 120, 160, 3), 70.0)
    for area in changing:
        frames[GRASP + 10 :, area[0], area[1]] += 100
    return np.clip(frames + rng.normal(0, 3, frames.shape), 0, 255).astype(np.uint8)


DOOR_OPENS = film([(slice(40, 80), slice(30, 60))])


def hand(gap_m: float, *, grips: bool = True) -> GripperSignals:
    """The hand comes as near as `gap_m` when it closes, and goes away with the part."""
    distances = gap_m + np.interp(np.arange(COUNT), [0, GRASP, COUNT], [0.4, 0.0, 0.3])
    closed = np.zeros(COUNT)
    closed[GRASP:RELEASE] = 0.8 if grips else 0.0
    return GripperSignals(
        times_s=TIMES,
        Ts_world_ee=np.tile(np.eye(4), (COUNT, 1, 1)),
        speeds_m_s=np.zeros(COUNT),
        gripper=closed,
        distances_m=distances,
    )


NOBODY = np.zeros((COUNT, 120, 160), bool)


def judged(
    parts: tuple[Array, Array, Array], gaps_m: tuple[float, float, float], *, grips: bool = True
) -> PartIdentification:
    signals, static, other = (hand(gap, grips=grips) for gap in gaps_m)
    rivals = static.distances_m, other.distances_m
    regions = find_visible_regions(*parts_scene(*parts), LEVEL)
    return identify_part(regions, signals, rivals, DOOR_OPENS, NOBODY)


@pytest.mark.parametrize("grips", [True, False])
def test_the_door_that_the_hand_opens_is_confirmed(grips: bool) -> None:
    moved = judged((DOOR, BODY, BOOKS), (0.003, 0.04, 0.2), grips=grips)
    assert moved.moving.gap_m == pytest.approx(0.003)
    assert moved.moving.changed > 0.85
    assert moved.static.changed < 0.05
    assert moved.odds > 10
    moved.check()
    assert list_warnings(moved.odds) == []


@pytest.mark.parametrize("grips", [True, False])
def test_swapped_prompts_are_refused_with_what_to_do(grips: bool) -> None:
    moved = judged((BODY, DOOR, BOOKS), (0.04, 0.003, 0.2), grips=grips)
    with pytest.raises(WrongPromptError, match="swap the boxes") as caught:
        moved.check()
    assert str(caught.value) == (
        "prompts of the moving part: the gripper moved the part that is prompted as 'static': the fingers closed "
        "40 mm from 'moving' and 3 mm from 'static', and the video changed 0 % of 'moving' and 100 % of "
        "'static'; in capture.toml, swap the boxes of 'moving' and 'static', or draw 'moving' around the door "
        "or drawer alone"
    )


def test_swapping_the_parts_inverts_the_odds() -> None:
    right = judged((DOOR, BODY, BOOKS), (0.003, 0.04, 5.0))
    swapped = judged((BODY, DOOR, BOOKS), (0.04, 0.003, 5.0))
    assert right.odds * swapped.odds == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("grips", [True, False])
def test_prompts_on_another_object_are_refused(grips: bool) -> None:
    moved = judged((BOOKS, BODY, DOOR), (0.3, 0.04, 0.003), grips=grips)
    with pytest.raises(WrongPromptError, match=r"neither part.*around the part that the robot moves"):
        moved.check()


def test_a_handle_missing_from_the_moving_part_is_doubted_or_passed_but_not_refused() -> None:
    moved = judged((DOOR, BODY, BOOKS), (0.045, 0.06, 0.002))
    moved.check()


def test_doubtful_prompts_are_told() -> None:
    near = CandidateEvidence(gap_m=0.01, changed=0.1)
    moved = PartIdentification(
        moving=near, static=near, other=CandidateEvidence(gap_m=9.0, changed=0.05), gripped=True
    )
    moved.check()
    assert moved.odds == pytest.approx(1.0)
    assert list_warnings(moved.odds) == [
        "contact and video fit the part prompted as 'moving' only 1.0 times as well as any other region, expected 2; "
        "check its boxes in capture.toml"
    ]
    assert list_warnings(MIN_ODDS) == []


def test_a_part_out_of_the_picture_is_judged_by_contact_alone() -> None:
    hidden = DOOR + [0.0, 30.0, 0.0]
    moved = judged((hidden, BODY, BOOKS), (0.003, 0.04, 0.2))
    assert moved.moving.changed == pytest.approx(0.05)
    assert moved.odds > 2


def test_the_robot_in_front_of_a_part_is_no_change() -> None:
    frames, robot = DOOR_OPENS.copy(), NOBODY.copy()
    robot[GRASP:, 60:90, 60:120] = True
    frames[robot] = 250
    rivals = hand(0.04).distances_m, hand(0.2).distances_m
    regions = find_visible_regions(*parts_scene(DOOR, BODY, BOOKS), LEVEL)
    moved = identify_part(regions, hand(0.003), rivals, frames, robot)
    assert moved.static.changed < 0.05


def test_the_nearer_surface_is_the_one_that_is_seen() -> None:
    front, behind = wall((30, 60), (40, 80)), wall((20, 120), (30, 90), depth=1.3)
    door, body = find_visible_regions(*parts_scene(front, behind), LEVEL)
    assert not np.any(door & body)
    assert door[60, 45]
    assert body[60, 100]
    assert not body[60, 45]
    assert door.sum() == pytest.approx(30 * 40, rel=0.35)


def test_a_surface_out_of_view_covers_nothing() -> None:
    door, none = find_visible_regions(*parts_scene(DOOR, np.array([[-1.0, 0, 0]])), LEVEL)
    assert door.any()
    assert not none.any()
