"""How the engine's gradients behave in torch's graph: what it reads stays alive, second derivatives are refused."""

import numpy as np
import pytest
import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.splatting.compute import image_loss
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions

CAMERA = Camera(width=40, height=30, fx=35.0, fy=35.0, cx=20.0, cy=15.0, T_world_cam=np.eye(4))
COUNT = 300


def leaves() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(5)
    means = torch.rand((COUNT, 3), generator=generator) * 2 - 1 + torch.tensor([0.0, 0.0, 3.0])
    tensors = {
        "means": means,
        "quats": torch.rand((COUNT, 4), generator=generator),
        "log_scales": torch.full((COUNT, 3), -3.0),
        "logit_opacities": torch.rand(COUNT, generator=generator),
        "sh": torch.rand((COUNT, 4, 3), generator=generator),
        "features": torch.rand((COUNT, 2), generator=generator),
    }
    return {name: tensor.requires_grad_() for name, tensor in tensors.items()}


def draw(inputs: dict[str, Tensor]) -> Tensor:
    drawn = CpuRasterizer()(GaussianTensors(**inputs), CAMERA, RasterOptions(sh_degree=1))
    assert drawn.features is not None
    return drawn.rgb.square().sum() + drawn.features.square().sum()


def test_the_scene_outlives_hooks_that_take_saved_tensors_away() -> None:
    want, have = leaves(), leaves()
    draw({name: leaf * 1 for name, leaf in want.items()}).backward()
    with torch.autograd.graph.saved_tensors_hooks(lambda t: t.numpy(force=True).copy(), torch.from_numpy):
        loss = draw({name: leaf * 1 for name, leaf in have.items()})  # products that only the graph holds
    rubbish = [torch.full_like(leaf, torch.nan) for leaf in want.values() for _ in range(4)]
    loss.backward()
    assert len(rubbish) == 4 * len(want)  # in the memory of whatever was freed
    for name, leaf in want.items():
        torch.testing.assert_close(have[name].grad, leaf.grad, rtol=0, atol=0)


def test_second_derivatives_are_refused() -> None:
    inputs = leaves()
    (first,) = torch.autograd.grad(draw(inputs), inputs["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        (first.square().sum() + inputs["means"].square().sum()).backward()
    image = torch.rand((3, 12, 14)).requires_grad_()
    loss = image_loss(image, torch.rand((3, 12, 14))).square()
    (first,) = torch.autograd.grad(loss, image, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        (first.square().sum() + image.square().sum()).backward()
