"""Poses of training cameras are corrected, and nothing drifts that images cannot see."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from aomgen.core.camera import Camera
from aomgen.core.progress import silent
from aomgen.core.transforms import (
    matrix_from_rotvec,
    rotvec_from_matrix,
    similarity_parts,
    transform,
)
from aomgen.splatting import native
from aomgen.splatting.optimizer import RATES
from aomgen.splatting.training import TrainingParams, learning, scene_extent, start_training, train
from aomgen.splatting.training_views import PoseIncrements, gauge_motions
from similarity_fit import best_similarity
from small_scene import checkered, photograph, ring, start


def perturbed(cameras: list[Camera], angle: float, length: float) -> list[Camera]:
    rng = np.random.default_rng(7)
    moved = []
    for camera in cameras:
        R = matrix_from_rotvec(angle * rng.normal(size=3))
        moved.append(camera.move(camera.T_world_cam @ transform(R, length * rng.normal(size=3))))
    return moved


def errors(cameras: list[Camera], truth: list[Camera]) -> tuple[float, float]:
    """Root mean square of rotation [rad] and centre after the best similarity between both."""
    centers, want = (np.array([camera.center for camera in some]) for some in (cameras, truth))
    S = best_similarity(centers, want)
    scale, R, t = similarity_parts(S)
    turns = [
        rotvec_from_matrix(b.T_world_cam[:3, :3].T @ R @ a.T_world_cam[:3, :3])
        for a, b in zip(cameras, truth, strict=True)
    ]
    distances = scale * centers @ R.T + t - want
    return float(np.sqrt(np.square(turns).sum(1).mean())), float(np.sqrt(np.square(distances).sum(1).mean()))


PARAMS = TrainingParams(
    iterations=1200,
    sh_degree=0,
    max_gaussians=2500,
    background=(0, 0, 0),
    downsampling=((0.0, 1),),
    refine_poses=True,
    refine_from=0.0,
    rates={**RATES, "poses": 4e-3, "color": 0.03},
)


@pytest.mark.slow
def test_perturbed_poses_are_found_again() -> None:
    scene, truth = checkered(4000, 0), ring(16) + ring(8, height=1.3, shift=0.5)
    given = perturbed(truth, 0.008, 0.013)
    initial = start(scene, 1500)
    state = start_training(initial, given, PARAMS, np.random.default_rng(0))
    for _ in learning(state, given, photograph(scene, truth), PARAMS, scene_extent(initial, given)):
        pass
    found = [state.poses.correct(i, camera) for i, camera in enumerate(given)]
    before, after = errors(given, truth), errors(found, truth)
    assert after[0] < before[0] / 3
    assert after[1] < before[1] / 3


def test_without_refinement_poses_stay() -> None:
    scene, cameras = checkered(500, 0), ring(4)
    params = replace(PARAMS, iterations=12, refine_poses=False)
    state = start_training(scene, cameras, params, np.random.default_rng(0))
    for _ in learning(state, cameras, photograph(scene, cameras), params, 1.0):
        pass
    assert not state.poses.values.any()
    assert state.poses.correct(1, cameras[1]) is cameras[1]


def test_refinement_waits_for_its_share() -> None:
    scene, cameras = checkered(500, 0), ring(4)
    params = replace(PARAMS, iterations=20, refine_from=0.5)
    state = start_training(scene, cameras, params, np.random.default_rng(0))
    moved = []
    for _ in learning(state, cameras, photograph(scene, cameras), params, 1.0):
        moved.append(bool(state.poses.values.any()))
    assert moved == [False] * 10 + [True] * 10


@pytest.mark.parametrize("kind", ["rotation", "translation", "scale"])
def test_motions_of_everything_are_taken_out(kind: str) -> None:
    """Twists that a small similarity of the scene explains lie in the gauge; others do not."""
    cameras = ring(6)
    middle, extent, size = np.array([0.1, -0.2, 0.1]), 1.7, 1e-3
    poses = PoseIncrements.neutral(cameras, middle, extent, enabled=True)
    S = np.eye(4)
    if kind == "rotation":
        S[:3, :3] = matrix_from_rotvec([size, -size, 0.5 * size])
        S[:3, 3] = middle - S[:3, :3] @ middle
    elif kind == "translation":
        S[:3, 3] = [size, 2 * size, -size]
    else:
        S[:3, :3] *= 1 + size
        S[:3, 3] = -size * middle
    # The twist of each camera that follows the scene: T_given exp(twist) = T_moved.
    twists = []
    for camera in cameras:
        R = S[:3, :3] / np.cbrt(np.linalg.det(S[:3, :3]))
        T_moved = transform(R @ camera.T_world_cam[:3, :3], S[:3, :3] @ camera.center + S[:3, 3])
        motion = camera.T_world_cam @ np.linalg.inv(T_moved)
        rotvec = rotvec_from_matrix(motion[:3, :3])
        twists.append([*rotvec, *((motion[:3, :3] @ middle + motion[:3, 3] - middle) / extent)])
    flat = np.array(twists).ravel()
    gauge = poses.gauge.double().numpy()
    rest = flat - gauge @ (gauge.T @ flat)
    assert np.linalg.norm(rest) < 0.01 * np.linalg.norm(flat)
    alone = np.zeros_like(flat)
    alone[0] = 1.0
    assert np.linalg.norm(alone - gauge @ (gauge.T @ alone)) > 0.5
    assert np.allclose(gauge.T @ gauge, np.eye(7), atol=1e-6)


def test_a_step_leaves_no_gauge_motion() -> None:
    cameras = ring(5)
    poses = PoseIncrements.neutral(cameras, np.zeros(3), 1.5, enabled=True)
    for index in (0, 3, 1):
        poses.step(index, torch.tensor([1.0, -2, 3, 0.5, 0, 1]), 1e-3, native.Context())
    assert poses.values.abs().max() > 1e-4
    assert (poses.gauge.T @ poses.values.view(-1)).abs().max() < 1e-8
    assert poses.steps.tolist() == [1, 1, 0, 1, 0]


def test_gauge_needs_no_more_than_two_cameras() -> None:
    assert gauge_motions(np.array([[1.0, 0, 0], [0, 1, 0]])).shape == (12, 7)


def test_training_with_refinement_is_reproducible() -> None:
    scene, cameras = checkered(500, 0), ring(4)
    params = replace(PARAMS, iterations=30)
    runs = [
        train(
            start(scene, 300), cameras, photograph(scene, cameras), params, silent, np.random.default_rng(5)
        )
        for _ in range(2)
    ]
    assert np.array_equal(runs[0].means, runs[1].means)
