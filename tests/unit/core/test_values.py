"""Core values keep their promises."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.assets.choice import make_asset
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, transform
from aomgen.core.values import Array, freeze_arrays

RNG = np.random.default_rng(0)


def some_gaussians(count: int = 5, coefficients: int = 4) -> Gaussians:
    quats = RNG.normal(size=(count, 4))
    return Gaussians(
        means=RNG.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=RNG.uniform(0.01, 0.1, (count, 3)),
        opacities=RNG.uniform(0, 1, count),
        sh=RNG.normal(size=(count, coefficients, 3)),
    )


def test_values_cannot_be_changed():
    gaussians = some_gaussians()
    with pytest.raises(ValueError, match="read-only"):
        gaussians.means[0] = 0
    with pytest.raises(AttributeError):
        gaussians.means = gaussians.means


def test_arrays_are_contiguous_whatever_they_came_from():
    """The engine reads them by address: a transposed view of a file's columns must not stay one."""
    gaussians = some_gaussians(5, 4)
    stored = np.asfortranarray(gaussians.sh)
    turned = gaussians.with_sh(stored)
    assert not stored.flags.c_contiguous
    assert turned.sh.flags.c_contiguous
    assert np.array_equal(turned.sh, gaussians.sh)


def test_wrong_shapes_are_a_programming_error():
    with pytest.raises(ValueError, match=r"Gaussians\.quats: has shape"):
        Gaussians(
            means=np.zeros((2, 3)),
            quats=np.zeros((2, 3)),
            scales=np.ones((2, 3)),
            opacities=np.ones(2),
            sh=np.zeros((2, 1, 3)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    names: Annotated[tuple[str, ...], "N"]
    points: Annotated[Array, "T N 3"]
    seen: Annotated[NDArray[np.bool_], "T N"] | None = None

    __post_init__ = freeze_arrays


def test_one_letter_is_one_length_in_the_whole_value():
    Track(names=("a", "b"), points=np.zeros((5, 2, 3)), seen=np.ones((5, 2)))
    Track(names=(), points=np.zeros((0, 0, 3)))
    with pytest.raises(ValueError, match=r"Track\.points: has shape \(5, 1, 3\); expected \(T N 3\)"):
        Track(names=("a", "b"), points=np.zeros((5, 1, 3)))
    with pytest.raises(ValueError, match=r"Track\.seen: has shape \(2,\)"):
        Track(names=("a", "b"), points=np.zeros((5, 2, 3)), seen=np.ones(2))


def test_arrays_take_the_declared_type():
    track = Track(names=("a",), points=[[[1, 2, 3]]], seen=[[1]])
    assert track.points.dtype == np.float64
    assert track.seen is not None
    assert track.seen.dtype == np.bool_


def test_moving_there_and_back_changes_nothing():
    gaussians = some_gaussians()
    S = similarity(3.0, matrix_from_rotvec([0.3, -0.5, 0.8]), [1, 2, 3])
    back = gaussians.transform(S).transform(np.linalg.inv(S))
    assert np.allclose(back.means, gaussians.means, atol=1e-5)
    assert np.allclose(back.scales, gaussians.scales, atol=1e-6)
    assert np.allclose(back.sh, gaussians.sh, atol=1e-5)
    assert np.allclose(np.abs(np.sum(back.quats * gaussians.quats, 1)), 1, atol=1e-5)


def test_concatenation_pads_to_the_highest_degree():
    both = concatenate([some_gaussians(3, 1), some_gaussians(2, 9)])
    assert len(both) == 5
    assert both.sh_degree == 2
    assert np.all(both.sh[:3, 1:] == 0)


def test_joint_log_interpolates_and_holds_its_ends():
    log = JointLog(
        times_s=[1.0, 2.0], joints=[[0.0, 1.0], [2.0, 3.0]], gripper=[0.0, 1.0], joint_names=("a", "b")
    )
    joints, gripper = log.at([0.0, 1.5, 9.0])
    assert np.allclose(joints, [[0, 1], [1, 2], [2, 3]])
    assert np.allclose(gripper, [0, 0.5, 1])
    assert log.covers([0.5, 1.5]).tolist() == [False, True]


def test_surface_samples_spread_by_area():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 0, 1], [0, 3, 1]], float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    normals, areas = face_normals_areas(vertices, faces)
    assert np.allclose(areas, [0.5, 4.5])
    assert np.allclose(normals, [[0, 0, 1], [0, 0, 1]])
    points, owners, weights = sample_surface(vertices, faces, 20_000, np.random.default_rng(1))
    assert np.mean(owners == 1) == pytest.approx(0.9, abs=0.01)
    assert np.allclose(weights.sum(1), 1)
    assert np.allclose(points[owners == 1].mean(0), [1, 1, 1], atol=0.03)


def test_a_scaled_asset_scales_everything():
    asset = make_asset("microwave", 4)
    S = similarity(1.5, matrix_from_rotvec([0, 0, 0.7]), [0.2, 0.1, 0.0])
    moved = asset.transform(S)
    assert moved.static.mass == pytest.approx(asset.static.mass * 1.5**3)
    assert moved.joint.upper == asset.joint.upper
    assert np.allclose(moved.handle_point, apply(S, asset.handle_point))
    box, source = moved.moving.colliders[0], asset.moving.colliders[0]
    assert np.allclose(box.half_extents, 1.5 * source.half_extents)
    corner = transform(np.eye(3), source.half_extents)[:3, 3]
    moved_corner = apply(box.T_asset_box, 1.5 * corner)
    assert np.allclose(moved_corner, apply(S, apply(source.T_asset_box, corner)))
