"""Laws of the core mathematics, held to scipy where it knows the answer."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aomgen.conventions import linear_from_srgb, srgb_from_linear, xyzw_from_wxyz
from aomgen.core.camera import Camera, look_at
from aomgen.core.joint import Joint
from aomgen.core.sh import rotate_sh, sh_basis
from aomgen.core.transforms import (
    angle_between,
    apply,
    interpolate,
    invert,
    matrix_from_quat,
    matrix_from_rotvec,
    quat_from_matrix,
    quat_multiply,
    rotvec_from_matrix,
    similarity,
    similarity_parts,
    transform,
)

RNG = np.random.default_rng(3)
ROTATIONS = Rotation.random(200, random_state=5)


def test_rotations_agree_with_scipy():
    assert np.allclose(matrix_from_rotvec(ROTATIONS.as_rotvec()), ROTATIONS.as_matrix(), atol=1e-12)
    assert np.allclose(rotvec_from_matrix(ROTATIONS.as_matrix()), ROTATIONS.as_rotvec(), atol=1e-9)
    wxyz = np.roll(ROTATIONS.as_quat(), 1, axis=-1)
    assert np.allclose(matrix_from_quat(wxyz), ROTATIONS.as_matrix(), atol=1e-12)
    assert np.allclose(xyzw_from_wxyz(wxyz), ROTATIONS.as_quat())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, np.pi - 1e-9, np.pi])
def test_rotation_vectors_survive_small_and_half_turns(angle):
    rotvec = angle * np.array([0.6, 0.0, 0.8])
    R = matrix_from_rotvec(rotvec)
    assert np.allclose(matrix_from_rotvec(rotvec_from_matrix(R)), R, atol=1e-12)


def test_quaternion_products_are_matrix_products():
    a, b = ROTATIONS[:100].as_matrix(), ROTATIONS[100:].as_matrix()
    product = quat_multiply(quat_from_matrix(a), quat_from_matrix(b))
    assert np.allclose(matrix_from_quat(product), a @ b, atol=1e-12)


def test_inverse_undoes_a_stack():
    T = transform(ROTATIONS.as_matrix(), RNG.normal(size=(200, 3)))
    assert np.allclose(invert(T) @ T, np.eye(4), atol=1e-12)


def test_a_similarity_comes_apart_and_together_again():
    S = similarity(0.07, ROTATIONS[3].as_matrix(), [1.0, -2.0, 3.0])
    scale, R, t = similarity_parts(S)
    assert np.isclose(scale, 0.07)
    assert np.allclose(similarity(scale, R, t), S)


def test_interpolation_ends_where_it_should_and_turns_evenly():
    T_a, T_b = transform(ROTATIONS[0].as_matrix(), [0, 0, 0]), transform(ROTATIONS[1].as_matrix(), [1, 2, 3])
    path = interpolate(T_a, T_b, np.linspace(0, 1, 5))
    assert np.allclose(path[0], T_a)
    assert np.allclose(path[-1], T_b)
    steps = [np.linalg.norm(rotvec_from_matrix(a[:3, :3].T @ b[:3, :3])) for a, b in itertools.pairwise(path)]
    assert np.allclose(steps, steps[0])


def test_angle_between_is_exact_near_zero_and_pi():
    assert angle_between([1, 0, 0], [1, 1e-9, 0]) == pytest.approx(1e-9)
    assert angle_between([1, 0, 0], [-1, 0, 0]) == pytest.approx(np.pi)


def test_rotated_sh_gives_the_same_color_in_the_rotated_direction():
    sh = RNG.normal(size=(6, 16, 3)).astype(np.float32)
    R = ROTATIONS[7].as_matrix()
    directions = RNG.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", sh_basis(directions, 3), sh)
    after = np.einsum("dk,nkc->ndc", sh_basis(directions @ R.T, 3), rotate_sh(sh, R))
    assert np.abs(before - after).max() < 1e-5


def test_joint_motion_keeps_the_axis_and_moves_with_its_frame():
    joint = Joint(type="revolute", axis=[0, 0, 1.0], origin=[0.3, 0.1, 0.0], lower=0, upper=2)
    on_axis = np.array([0.3, 0.1, 0.7])
    assert np.allclose(apply(joint.motion(1.2), on_axis), on_axis)
    S = similarity(2.0, ROTATIONS[9].as_matrix(), [1, 2, 3])
    point = np.array([0.5, -0.2, 0.4])
    assert np.allclose(
        apply(S, apply(joint.motion(0.8), point)), apply(joint.move(S).motion(0.8), apply(S, point))
    )
    slide = Joint(type="prismatic", axis=[1, 0, 0.0], origin=[0, 0, 0.0], lower=0, upper=0.3)
    assert np.allclose(
        apply(S, apply(slide.motion(0.1), point)), apply(slide.move(S).motion(0.2), apply(S, point))
    )


def test_camera_projects_its_rays_back_to_pixel_centres():
    camera = Camera(
        fx=300, fy=310, cx=158, cy=122, width=320, height=240, T_world_cam=look_at([1, 2, 3], [0, 0, 0.5])
    )
    points = camera.center + 2.5 * camera.directions()
    pixels, depths = camera.project(points.reshape(-1, 3))
    assert np.allclose(depths, 2.5)
    assert np.allclose(pixels.reshape(240, 320, 2)[10, 20], [20.5, 10.5])
    half = camera.resize(160, 120)
    assert np.allclose(half.project(points[10, 20][None])[0], [[10.25, 5.25]])


def test_srgb_round_trip():
    values = np.linspace(0, 1, 100)
    assert np.allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)
