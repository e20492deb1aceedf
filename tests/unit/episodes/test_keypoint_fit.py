"""Shape and pose of an unknown object follow from its keypoints in images."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera, look_at
from aomgen.core.joint import LIMIT_SHARE
from aomgen.core.keypoints import find_keypoints
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.episodes.keypoint_fit import ADDED_SD, LARGEST_SD, fit_known_objects, stretch

SIDE = 240
RECORDED = transform(matrix_from_rotvec(np.array([0.0, 0.0, 0.4 - np.pi / 2])), np.array([0.7, 0.0, 0.1]))
STRETCH, VARIATION = np.array([1.08, 0.95, 1.05]), Variation(seed=0, index=0, x=0.1, y=-0.08, yaw=0.5)


def place(asset: ArticulatedAsset) -> FittedAsset:
    return FittedAsset(
        asset=asset,
        T_world_asset=RECORDED,
        contact_asset=asset.handle_point,
        shares=np.array([0.0, 1.0]),
        thetas=np.array([0.0, 1.0]),
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )


@pytest.fixture(scope="module")
def known(made: Callable[[str, int], ArticulatedAsset]) -> list[FittedAsset]:
    return [place(made("microwave", seed)) for seed in range(4)]


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    eyes = np.array([[-0.1, 0.9, 0.9], [0.1, -0.9, 0.8], [-0.2, 0.0, 0.7]])
    return [
        Camera(
            fx=230, fy=230, cx=120, cy=120, width=SIDE, height=SIDE, T_world_cam=look_at(eye, (0.7, 0, 0.2))
        )
        for eye in eyes
    ]


def detect(cameras: list[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    return pixels, np.full(pixels.shape[:2], 1.0)


def test_the_shape_and_the_pose_of_a_stretched_object_are_recovered(
    known: list[FittedAsset], cameras: list[Camera]
) -> None:
    shape = stretch(known[2], STRETCH)
    T = VARIATION.place_at(shape)
    truth = apply(T, find_keypoints(shape.asset))
    rough = truth + np.random.default_rng(0).normal(0, 0.03, truth.shape)
    (best, variation), *others = fit_known_objects(known, cameras, *detect(cameras, truth), rough)
    assert len(others) < len(known)
    found = apply(variation.place_at(best), find_keypoints(best.asset))
    # The prior of the sizes shifts points by a few millimeters.
    assert np.linalg.norm(found - truth, axis=1).max() < 0.006
    assert variation.yaw == pytest.approx(VARIATION.yaw, abs=0.03)
    assert best.asset.name == known[2].asset.name


@pytest.mark.parametrize("size", [0.6, 1.5])
def test_an_object_of_another_size_is_recovered(
    known: list[FittedAsset], cameras: list[Camera], size: float
) -> None:
    shape = stretch(known[2], size * STRETCH)
    T = VARIATION.place_at(shape)
    truth = apply(T, find_keypoints(shape.asset))
    rough = truth + np.random.default_rng(0).normal(0, 0.03, truth.shape)
    best, variation = fit_known_objects(known, cameras, *detect(cameras, truth), rough)[0]
    found = apply(variation.place_at(best), find_keypoints(best.asset))
    assert np.linalg.norm(found - truth, axis=1).max() < 0.008


def test_an_outlier_and_detections_without_information_change_little(
    known: list[FittedAsset], cameras: list[Camera]
) -> None:
    T = VARIATION.place_at(known[1])
    truth = apply(T, find_keypoints(known[1].asset))
    pixels, sds = detect(cameras, truth)
    pixels[0, 3] += 60.0
    pixels[2], sds[2] = SIDE / 2, 1.01 * LARGEST_SD * SIDE
    best, variation = fit_known_objects(known, cameras, pixels, sds, truth)[0]
    found = apply(variation.place_at(best), find_keypoints(best.asset))
    assert np.linalg.norm(found - truth, axis=1).max() < 3 * ADDED_SD * 0.9 / 230 * SIDE


def test_an_object_that_faces_away_is_not_explained_by_its_back(
    known: list[FittedAsset], cameras: list[Camera]
) -> None:
    turned = Variation(seed=0, index=0, x=0.0, y=0.0, yaw=np.pi)
    truth = apply(turned.place_at(known[0]), find_keypoints(known[0].asset))
    assert fit_known_objects(known[:1], cameras, *detect(cameras, truth), truth) == []


def test_stretched_colliders_have_the_scaled_corners(known: list[FittedAsset]) -> None:
    before, after = known[0], stretch(known[0], STRETCH)
    for link in ("static", "moving"):
        boxes = zip(getattr(before.asset, link).colliders, getattr(after.asset, link).colliders, strict=True)
        for old, new in boxes:
            if np.allclose(np.abs(old.T_asset_box[:3, :3]).max(0), 1.0):
                np.testing.assert_allclose(new.corners, old.corners * STRETCH, atol=1e-9)
    np.testing.assert_allclose(after.contact_asset, before.contact_asset * STRETCH)
    np.testing.assert_allclose(find_keypoints(after.asset), find_keypoints(before.asset) * STRETCH, atol=1e-6)
    assert after.asset.static.mass == pytest.approx(before.asset.static.mass * STRETCH.prod())


@pytest.mark.parametrize(("factor", "share"), [(0.5, 0.5), (1.5, 1.0)])
def test_a_slide_is_opened_within_its_stretched_range(
    made: Callable[[str, int], ArticulatedAsset], factor: float, share: float
) -> None:
    drawer = made("drawer", 1)
    target = LIMIT_SHARE * drawer.joint.upper
    fitted = replace(place(drawer), thetas=np.array([0.0, target]))
    factors = 1.0 + (factor - 1.0) * np.abs(drawer.joint.axis)
    shape = stretch(fitted, factors)
    assert shape.asset.joint.upper == pytest.approx(factor * drawer.joint.upper)
    assert shape.travel == pytest.approx(share * target)
