"""Errors of cameras, together, and what they do to an alignment that rests on them."""

import numpy as np
import pytest

from aomgen.alignment.confidence import ViewEvidence
from aomgen.alignment.contours import Contour, shift_gradient, shift_jacobian
from aomgen.alignment.uncertainty import CameraErrors, camera_covariance, covariance_from_cameras
from aomgen.core.camera import Camera, camera_in_world, look_at
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity

S_OTHER_WORLD = similarity(4.0, matrix_from_rotvec([0.5, -1.0, 2.0]), [3.0, 1.0, -2.0])
PIVOT = np.array([0.1, 0.0, 0.2])


def cameras(count: int = 8) -> list[Camera]:
    angles = np.linspace(0, 2.5, count)
    return [
        Camera(
            fx=300.0, fy=300.0, cx=160.0, cy=120.0, width=320, height=240,
            T_world_cam=look_at([2 * np.cos(a), 2 * np.sin(a), 0.8 + 0.1 * np.sin(5 * a)], [0, 0, 0.2]),
        )
        for a in angles
    ]  # fmt: skip


def scene(points: int = 150, seen_by: int = 8):
    """Points of a room, and who sees which."""
    rng = np.random.default_rng(0)
    sightings = [(p, c) for p in range(points) for c in rng.permutation(8)[:seen_by]]
    return rng.uniform(-0.7, 0.7, (points, 3)), np.array(sightings, np.int32)


def evidence(views: list[Camera], edge_px: float = 0.0) -> list[ViewEvidence]:
    """Outline points scattered about the robot, in every view."""
    rng = np.random.default_rng(1)
    found = []
    for number, camera in enumerate(views):
        points, angles = rng.uniform(-0.4, 0.4, (60, 3)), rng.uniform(0, 6.28, 60)
        normals = np.stack([np.cos(angles), np.sin(angles)], 1)
        contour = Contour(pixels=camera.project(points)[0], normals=normals, points=points)
        gradient = shift_gradient(camera, contour)
        found.append(
            ViewEvidence(
                name=f"{number}",
                segments=np.ones(60, np.int64),
                confirmed=np.ones(60, bool),
                by_chance=np.zeros(60, bool),
                edge_px=rng.choice([-1, 1], 60) * edge_px,
                edge_weights=np.ones(60),
                border_px=np.zeros(60),
                border_weights=np.ones(60),
                jacobian=shift_jacobian(camera, contour, PIVOT),
                joint_jacobian=np.zeros((60, 0)),
                camera_jacobian=np.concatenate([gradient, np.cross(points - camera.center, gradient)], 1),
                normals=normals,
            )
        )
    return found


def errors_along(moves: np.ndarray) -> CameraErrors:
    """Cameras that are off by these moves (N, 6), times one random number."""
    return CameraErrors(
        names=tuple(f"{n}" for n in range(len(moves))), covariance=np.outer(moves.ravel(), moves.ravel())
    )


def test_covariance_follows_the_frame():
    points, sightings = scene()
    here = CameraErrors(
        names=tuple("abcdefgh"), covariance=camera_covariance(cameras(), points, sightings, 0.5)
    )
    moved = [camera_in_world(S_OTHER_WORLD, camera) for camera in cameras()]
    there = camera_covariance(moved, apply(S_OTHER_WORLD, points), sightings, 0.5)
    assert here.view_from(S_OTHER_WORLD).covariance == pytest.approx(there, rel=1e-3, abs=1e-4 * there.max())


def test_covariance_grows_with_the_reprojection_error_and_shrinks_with_points():
    points, sightings = scene()
    once = np.trace(camera_covariance(cameras(), points, sightings, 0.5))
    assert np.trace(camera_covariance(cameras(), points, sightings, 1.0)) == pytest.approx(4 * once, rel=1e-6)
    more, seen = scene(points=600)
    assert np.trace(camera_covariance(cameras(), more, seen, 0.5)) < 0.5 * once


def test_no_similarity_is_left_in_the_errors_of_centres():
    points, sightings = scene()
    covariance = camera_covariance(cameras(), points, sightings, 0.5)
    centers = covariance.reshape(8, 6, 8, 6)[:, :3, :, :3]
    together = centers.sum((0, 2))
    assert np.abs(together).max() < 1e-9 * np.trace(covariance) + 1e-12
    assert np.linalg.eigvalsh(covariance).min() > -1e-9 * np.trace(covariance)


def test_cameras_that_are_off_together_take_the_robot_along():
    t = np.array([0.002, -0.001, 0.003])
    moves = np.tile(np.append(t, np.zeros(3)), (8, 1))
    covariance = covariance_from_cameras(evidence(cameras()), errors_along(moves))
    assert covariance[3:6, 3:6] == pytest.approx(np.outer(t, t), rel=1e-3, abs=1e-10)
    assert np.abs(covariance[:3, :3]).max() < 1e-10


def test_a_camera_that_shows_no_robot_does_no_harm():
    moves = np.zeros((9, 6))
    moves[8] = 0.01
    assert np.abs(covariance_from_cameras(evidence(cameras()), errors_along(moves))).max() < 1e-15


def test_cameras_that_are_seen_to_be_worse_are_believed_to_be():
    rng = np.random.default_rng(2)
    moves = rng.normal(0, 1e-4, (8, 6))
    calm = covariance_from_cameras(evidence(cameras()), errors_along(moves))
    off = covariance_from_cameras(evidence(cameras(), edge_px=5.0), errors_along(moves))
    assert np.trace(off) > 3 * np.trace(calm)


def test_without_known_cameras_nothing_is_added():
    errors = CameraErrors(names=("unknown",), covariance=np.eye(6))
    assert np.abs(covariance_from_cameras(evidence(cameras()), errors)).max() == 0
