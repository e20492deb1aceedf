"""Whether a part moved at all: signs weighed by hand, and a drawn scene in which it does or does not."""

import numpy as np
import pytest

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.values import Array
from aomgen.errors import NoMotionError
from aomgen.motion.motion_test import FollowingEstimate, MotionEvidence, estimate_following
from aomgen.splatting.rasterizer import render

BLIND = FollowingEstimate(share=0.0, sd=float("inf"))
CAMERA = Camera(
    fx=100, fy=100, cx=48, cy=32, width=96, height=64, T_world_cam=look_at([0, -1.0, 0], [0, 0, 0])
)


def signs(
    changed: float, share: FollowingEstimate = BLIND, *, near: float = 0.0, travel: float = 0.2
) -> MotionEvidence:
    return MotionEvidence(changed=changed, following=share, nearest_m=near, travel_m=travel)


@pytest.mark.parametrize(
    ("changed", "share", "moved"),
    [(0.4, 0.8, True), (0.02, 0.9, True), (0.0, 0.0, False), (0.1, 0.0, False), (0.4, 0.4, True), (0.2, -0.1, False)],
)  # fmt: skip
def test_change_and_following_are_weighed_together(changed: float, share: float, moved: bool) -> None:
    assert (signs(changed, FollowingEstimate(share=share, sd=0.01)).log_likelihood_ratio > 0) == moved


def test_what_cannot_be_seen_says_nothing() -> None:
    assert signs(0.3).log_likelihood_ratio == pytest.approx(3.0)
    assert signs(0.3, FollowingEstimate(share=0.0, sd=1e6)).log_likelihood_ratio == pytest.approx(3.0)


def test_a_hand_that_only_closes_does_not_pull() -> None:
    pushed_around = FollowingEstimate(share=0.9, sd=0.02)
    assert signs(0.01, pushed_around, travel=0.002).log_likelihood_ratio < 0


def test_refusals_name_their_reason() -> None:
    with pytest.raises(NoMotionError, match="the hand never touches the part: it stays 25 cm away"):
        signs(0.5, near=0.25).check()
    locked = signs(0.03, FollowingEstimate(share=0.02, sd=0.01), travel=0.3)
    with pytest.raises(NoMotionError, match=r"the hand moves 300 mm .* follows by 2 % .* 3 % of its picture"):
        locked.check()
    signs(0.4, FollowingEstimate(share=0.8, sd=0.01)).check()


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
            [gaussians.select(labels == MOVING).transformed(T), gaussians.select(labels == STATIC)]
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
    assert moved.share == pytest.approx(1.0, abs=0.15)
    assert abs(stood.share) < 0.35
    assert signs(0.01, moved).log_likelihood_ratio > 0 > signs(0.05, stood).log_likelihood_ratio
