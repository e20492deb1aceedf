"""Training computes the same with the engine's loss and optimizer and with torch's."""

import numpy as np
import pytest
import torch

from aomgen.errors import BackendError
from aomgen.splatting.compute import Compute, NativeCompute, TorchCompute, make_compute
from aomgen.splatting.differentiable import CpuRasterizer
from aomgen.splatting.training import TrainingParams, learning, scene_extent, start_training
from small_scene import checkered, photograph, ring, start

PARAMS = TrainingParams(
    iterations=40,
    sh_degree=1,
    max_gaussians=700,
    grow_every=10,
    downsampling=((0.0, 1),),
    background=(0.1, 0.1, 0.1),
)


def losses(compute: Compute) -> tuple[list[float], torch.Tensor]:
    scene, cameras = checkered(600, 0), ring(4)
    images, initial = photograph(scene, cameras), start(scene, 500)
    state = start_training(initial, cameras, PARAMS, np.random.default_rng(0))
    state.parameters = state.parameters.move(compute.device)
    found = list(learning(state, cameras, images, PARAMS, scene_extent(initial, cameras), compute))
    return found, state.parameters.move("cpu").values["means"]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_torch_and_engine_learn_the_same(device: str) -> None:
    if device == "cuda":
        try:
            compute = make_compute("cuda")
        except BackendError as error:
            pytest.skip(str(error))
    else:
        compute = TorchCompute("cpu", CpuRasterizer())
    native, native_means = losses(NativeCompute())
    ours, means = losses(compute)
    assert native[-1] < 0.75 * native[0]
    np.testing.assert_allclose(ours[:10], native[:10], rtol=1e-3)
    np.testing.assert_allclose(ours, native, rtol=0.1)  # rounding chooses other parents to split
    assert len(means) == len(native_means) == 700


def test_every_device_has_its_compute() -> None:
    assert isinstance(make_compute("cpu"), NativeCompute)
    if not torch.cuda.is_available():
        with pytest.raises(BackendError, match="no CUDA device"):
            make_compute("cuda")
    with pytest.raises(BackendError, match="device 'tpu' is unknown"):
        make_compute("tpu")
