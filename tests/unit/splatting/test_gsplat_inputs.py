"""Scenes that are refused before gsplat sees them, and Gaussians that are left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import invert
from aomgen.errors import BackendError
from aomgen.splatting.differentiable import GaussianTensors, PartTensors
from aomgen.splatting.gsplat_inputs import (
    check_parts,
    check_scene,
    finite_only,
    multiply_quats,
    place_in_world,
    rotation_quats,
    view_directions,
)

CAMERA = Camera(fx=9, fy=9, cx=4, cy=3, width=8, height=6, T_world_cam=np.eye(4))
NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


def gaussians(count: int = 5) -> GaussianTensors:
    rng = np.random.default_rng(0)
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, 4, 3)]
    tensors = [torch.tensor(rng.normal(size=shape), dtype=torch.float32) for shape in shapes]
    return GaussianTensors(**dict(zip(NAMES, tensors, strict=True)))


def test_a_good_scene_passes() -> None:
    check_scene(gaussians(), CAMERA, 1)
    check_scene(replace(gaussians(0), features=torch.zeros(0, 2)), CAMERA, 0)
    check_parts(
        gaussians(),
        PartTensors(indices=torch.tensor([0, 1, 1, 0, 1]), Ts_world_part=torch.eye(4).repeat(2, 1, 1)),
    )


@pytest.mark.parametrize("name", NAMES)
def test_wrong_shapes_and_types_are_refused(name: str) -> None:
    good = gaussians()
    value = getattr(good, name)
    if name != "means":
        with pytest.raises(ValueError, match=f"{name} have shape"):
            check_scene(replace(good, **{name: value[:-1]}), CAMERA, 0)
    with pytest.raises(TypeError, match=f"{name}: expected float32 on cpu, got torch.float64 on cpu"):
        check_scene(replace(good, **{name: value.double()}), CAMERA, 0)


def test_flat_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match=r"sh have shape \(5, 12\), expected \(5, 1, 3\)"):
        check_scene(replace(gaussians(), sh=torch.zeros(5, 12)), CAMERA, 0)


@pytest.mark.parametrize("degree", [-1, 2, 4])
def test_degrees_without_coefficients_are_refused(degree: int) -> None:
    with pytest.raises(BackendError, match=f"SH degree {degree} of 4 coefficients"):
        check_scene(gaussians(), CAMERA, degree)


@pytest.mark.parametrize("indices", [[0, 0, 2, 0, 0], [0, -1, 0, 0, 0]])
def test_indices_without_a_part_are_refused(indices: list[int]) -> None:
    parts = PartTensors(indices=torch.tensor(indices), Ts_world_part=torch.eye(4).repeat(2, 1, 1))
    with pytest.raises(BackendError, match=f"part indices {min(indices)} to {max(indices)} of 2 transforms"):
        check_parts(gaussians(), parts)


def test_too_few_indices_are_refused() -> None:
    with pytest.raises(ValueError, match=r"parts \(3,\) and transforms \(1, 4, 4\) of 5 Gaussians"):
        check_parts(gaussians(), PartTensors(indices=torch.zeros(3), Ts_world_part=torch.eye(4)[None]))


def test_finite_gaussians_are_passed_on_untouched() -> None:
    good = gaussians()
    assert finite_only(good) is good
    opaque = replace(good, logit_opacities=torch.full((5,), torch.inf))
    assert finite_only(opaque) is opaque


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, torch.nan) for name in NAMES] + [("means", torch.inf), ("log_scales", 100.0), ("quats", 0.0)],
)
def test_others_become_invisible(name: str, value: float) -> None:
    broken = gaussians()
    row = getattr(broken, name)[2:3]
    row[...] = value
    good = finite_only(broken)
    assert good.logit_opacities.sigmoid()[2] == 0
    for array in (good.means, good.quats, good.log_scales.exp(), good.sh):
        assert array.isfinite().all()
    rest = [0, 1, 3, 4]
    for one in NAMES:
        assert torch.equal(getattr(good, one)[rest], getattr(broken, one)[rest])


def poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([look_at(rng.normal(size=3), rng.normal(size=3)) for _ in range(count)])


def random_gaussians(count: int) -> Gaussians:
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.ones((count, 3), np.float32),
        opacities=np.ones(count, np.float32),
        sh=rng.normal(size=(count, 16, 3)).astype(np.float32),
    )


def part_tensors(Ts_world_part: np.ndarray, count: int) -> PartTensors:
    indices = torch.arange(count, dtype=torch.int32) % len(Ts_world_part)
    return PartTensors(indices=indices, Ts_world_part=torch.tensor(Ts_world_part))


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) by turning the three axes as pure quaternions."""
    inverse = quats * quats.new_tensor([1, -1, -1, -1])
    axes = torch.eye(4, dtype=quats.dtype)[1:]
    turned = [multiply_quats(multiply_quats(quats, axis.expand_as(quats)), inverse) for axis in axes]
    return torch.stack([column[:, 1:] for column in turned], -1)


def test_gaussians_move_with_their_parts() -> None:
    gaussians, Ts = random_gaussians(12), poses(3)
    parts = part_tensors(Ts, 12)
    means, quats = place_in_world(
        torch.tensor(gaussians.means).double(), 3 * torch.tensor(gaussians.quats).double(), parts
    )
    for part, T in enumerate(Ts):
        rows = np.arange(12) % 3 == part
        want = gaussians.select(rows).transform(T)
        np.testing.assert_allclose(means[rows], want.means, atol=1e-6)
        have = quats[rows] / 3
        signs = torch.sign((have * torch.tensor(want.quats)).sum(-1, keepdim=True))
        np.testing.assert_allclose(have * signs, want.quats, atol=1e-6)


def test_colors_turn_with_their_parts() -> None:
    """Coefficients seen from the part's frame are the rotated coefficients seen from the world."""
    gaussians, Ts, T_cam_world = random_gaussians(12), poses(3), invert(poses(1, seed=5)[0])
    means = torch.tensor(gaussians.means).double()
    directions = view_directions(means, torch.tensor(T_cam_world), part_tensors(Ts, 12)).numpy()
    center = invert(T_cam_world)[:3, 3]
    for part, T in enumerate(Ts):
        rows = np.arange(12) % 3 == part
        moved = gaussians.select(rows).transform(T)
        want = np.einsum("nk,nkc->nc", _basis(moved.means - center), moved.sh)
        have = np.einsum("nk,nkc->nc", _basis(directions[rows]), gaussians.sh[rows])
        np.testing.assert_allclose(have, want, atol=1e-4)


def _basis(directions: np.ndarray) -> np.ndarray:
    return sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 3)


def test_without_parts_directions_start_at_the_camera() -> None:
    T_world_cam = poses(1)[0]
    means = torch.tensor([[1.0, 2.0, 3.0], T_world_cam[:3, 3].tolist()], dtype=torch.float64)
    have = view_directions(means, torch.tensor(invert(T_world_cam)), None)
    np.testing.assert_allclose(have[0], [1, 2, 3] - T_world_cam[:3, 3], atol=1e-12)


def test_a_gaussian_at_the_camera_has_some_direction() -> None:
    means = torch.zeros((1, 3), requires_grad=True)
    directions = view_directions(means, torch.eye(4), None)
    assert directions.norm() > 0
    torch.nn.functional.normalize(directions, dim=-1).sum().backward()
    assert means.grad is not None
    assert means.grad.abs().max() == 0


def test_rotation_quats_hold_everywhere() -> None:
    """Also at the half turns, where a single formula divides by zero."""
    half_turns = [np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])]
    matrices = torch.tensor(np.concatenate([poses(40)[:, :3, :3], half_turns]))
    quats = rotation_quats(matrices)
    np.testing.assert_allclose(quats.norm(dim=-1), 1, atol=1e-12)
    np.testing.assert_allclose(rotations(quats), matrices, atol=1e-7)


@pytest.mark.parametrize("name", ["half turn", "any", "none"])
def test_gradients_by_rigid_motions_are_exact(name: str) -> None:
    """Along a rotation, the placed Gaussian changes as finite differences say."""
    R = {"half turn": np.diag([-1.0, 1, -1]), "any": poses(1)[0, :3, :3], "none": np.eye(3)}[name]
    rng = np.random.default_rng(3)
    axis, weights = torch.tensor(rng.normal(size=3)), torch.tensor(rng.normal(size=(1, 3, 3)))
    mean, quat = torch.tensor(rng.normal(size=(1, 3))), torch.tensor(rng.normal(size=(1, 4)))
    T_cam_world = torch.tensor(invert(poses(1, seed=8)[0]))

    def value(angle: torch.Tensor) -> torch.Tensor:
        x, y, z = (angle * axis).unbind()
        zero = torch.zeros_like(x)
        spin = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = torch.matrix_exp(spin) @ torch.tensor(R)
        parts = PartTensors(indices=torch.zeros(1, dtype=torch.int32), Ts_world_part=T[None])
        means, quats = place_in_world(mean, quat, parts)
        directions = view_directions(mean, T_cam_world, parts)
        return (rotations(quats) * weights).sum() + means.square().sum() + directions[0, 0] ** 3

    start = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (have,) = torch.autograd.grad(value(start), start)
    step = torch.tensor(1e-6, dtype=torch.float64)
    want = (value(step) - value(-step)) / 2e-6
    assert abs(want.item()) > 0.1
    assert have.item() == pytest.approx(want.item(), rel=1e-6)
