"""The loss in torch, which a GPU trains with, against the native one and float64."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

import splatting_reference as reference
from aomgen.splatting.compute import image_loss, torch_image_loss


@pytest.fixture(scope="module", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def images(size: tuple[int, int], smooth: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture and its target; smooth ones have windows of almost no variance."""
    rng = np.random.default_rng(8)
    rows, columns = np.mgrid[: size[0], : size[1]] / max(size)
    target = np.stack([0.3 + 0.4 * rows, 0.6 - 0.3 * columns, 0.5 + 0.2 * rows * columns])
    noise = 0.01 if smooth else 0.25
    return (
        torch.tensor(target + noise * rng.normal(size=target.shape), dtype=torch.float32),
        torch.tensor(target, dtype=torch.float32),
    )


@pytest.mark.parametrize("dssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("size", "smooth"), [((37, 53), False), ((40, 31), True), ((8, 5), False)])
def test_torch_and_native_loss_agree(size: tuple[int, int], smooth: bool, dssim_weight: float) -> None:
    rendered, target = images(size, smooth)
    gains = torch.tensor([0.9, 1.0, 1.2])
    results = []
    for loss in (torch_image_loss, image_loss):
        x, g = rendered.clone().requires_grad_(), gains.clone().requires_grad_()
        value = loss(x, target, gains=g, dssim_weight=dssim_weight)
        (3 * value).backward()
        results.append((value.item(), x.grad.numpy(), g.grad.numpy()))
    have, want = results
    assert have[0] == pytest.approx(want[0], abs=1e-5)
    np.testing.assert_allclose(have[1], want[1], atol=2e-3 * np.abs(want[1]).max())
    np.testing.assert_allclose(have[2], want[2], rtol=1e-3, atol=1e-5)


def test_torch_loss_matches_float64() -> None:
    rendered, target = (image.double() for image in images((29, 45), smooth=False))
    gains = torch.tensor([0.9, 1.0, 1.2], dtype=torch.float64)
    pairs = [(rendered.clone().requires_grad_(), gains.clone().requires_grad_()) for _ in range(2)]
    have = torch_image_loss(pairs[0][0], target, gains=pairs[0][1], dssim_weight=0.2)
    want = reference.image_loss(pairs[1][0], target, pairs[1][1], 0.2)
    have.backward()
    want.backward()
    assert have.item() == pytest.approx(want.item(), abs=1e-12)
    for got, expected in zip(pairs[0], pairs[1], strict=True):
        np.testing.assert_allclose(got.grad, expected.grad, atol=1e-12)


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\(3, 4, 5\) and \(3, 5, 4\)"):
        torch_image_loss(torch.zeros(3, 4, 5), torch.zeros(3, 5, 4))
