"""Scenes that are refused before gsplat sees them, and Gaussians that are left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from aomgen.core.camera import Camera
from aomgen.errors import BackendError
from aomgen.splatting.differentiable import GaussianTensors, PartTensors
from aomgen.splatting.gsplat_inputs import check_parts, check_scene, finite_only

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
    with pytest.raises(TypeError, match=f"{name}: want float32 on cpu, got torch.float64 on cpu"):
        check_scene(replace(good, **{name: value.double()}), CAMERA, 0)


def test_flat_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match=r"sh have shape \(5, 12\), want \(5, 1, 3\)"):
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
