"""Adam in torch, which a GPU trains with, against the engine's."""

import numpy as np
import pytest
import torch

from aomgen.splatting import native
from aomgen.splatting.compute import torch_adam_step


@pytest.mark.parametrize("shape", [(17,), (17, 3), (9, 4, 3)])
def test_torch_and_native_steps_agree(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(2)
    start = torch.tensor(rng.normal(size=shape), dtype=torch.float32)
    columns = max(1, start[0].numel())
    rates = torch.tensor(rng.uniform(1e-3, 1e-1, columns), dtype=torch.float32)
    ours = [start.clone(), torch.zeros(shape), torch.zeros(shape)]
    want = [start.clone(), torch.zeros(shape), torch.zeros(shape)]
    context = native.Context(threads=1)
    for step in range(1, 6):
        gradient = torch.tensor(rng.normal(size=shape), dtype=torch.float32)
        gradient[0] = 0  # a Gaussian that no image has seen yet stays where it is
        torch_adam_step(ours[0], gradient, ours[1], ours[2], rates, step)
        addresses = (want[0], gradient, want[1], want[2], rates)
        first, second, third, fourth, fifth = (tensor.data_ptr() for tensor in addresses)
        context.adam_step((len(start), columns), (first, second, third, fourth, fifth), step)
    assert torch.equal(ours[0][0], start[0])
    assert (ours[0][1:] - start[1:]).abs().min() > 1e-4
    for have, expected in zip(ours, want, strict=True):
        np.testing.assert_allclose(have, expected, rtol=2e-5, atol=1e-6)


def test_steps_count_from_one() -> None:
    with pytest.raises(ValueError, match="step 0"):
        zeros = torch.zeros(2, 3)
        torch_adam_step(zeros, zeros, zeros, zeros, torch.zeros(3), 0)
