"""What training computes with on its device: a rasterizer, the image loss and steps of the optimizer."""

from typing import Protocol

from torch import Tensor

from aomgen.splatting import loss, native, torch_kernels
from aomgen.splatting.differentiable import CpuRasterizer, Rasterizer
from aomgen.splatting.rasterizers import make_rasterizer


class Compute(Protocol):
    """Tensors given to its functions are on `device`."""

    device: str
    draw: Rasterizer

    def image_loss(
        self, rendered: Tensor, target: Tensor, *, gains: Tensor | None, dssim_weight: float
    ) -> Tensor:
        """L1 and D-SSIM, see `loss.image_loss`."""
        ...

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        """Adam in place, see `torch_kernels.adam_step`."""
        ...


class NativeCompute:
    """The engine, on the processor."""

    device = "cpu"

    def __init__(self, context: native.Context | None = None) -> None:
        self._context = context or native.Context()
        self.draw: Rasterizer = CpuRasterizer(self._context)

    def image_loss(
        self, rendered: Tensor, target: Tensor, *, gains: Tensor | None, dssim_weight: float
    ) -> Tensor:
        """See `Compute`."""
        return loss.image_loss(
            rendered, target, gains=gains, dssim_weight=dssim_weight, context=self._context
        )

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        """See `Compute`."""
        columns = values[0].numel() if len(values) else 1
        tensors = (values, gradient.contiguous(), *moments, rates)
        first, second, third, fourth, fifth = (tensor.data_ptr() for tensor in tensors)
        self._context.adam_step((len(values), columns), (first, second, third, fourth, fifth), step)


class TorchCompute:
    """Plain torch around a rasterizer, on its device."""

    def __init__(self, device: str, draw: Rasterizer) -> None:
        self.device, self.draw = device, draw

    def image_loss(
        self, rendered: Tensor, target: Tensor, *, gains: Tensor | None, dssim_weight: float
    ) -> Tensor:
        """See `Compute`."""
        return torch_kernels.image_loss(rendered, target, gains=gains, dssim_weight=dssim_weight)

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        """See `Compute`."""
        torch_kernels.adam_step(values, gradient, *moments, rates, step)


def make_compute(device: str) -> Compute:
    """The engine for "cpu", torch and gsplat for "cuda".

    Raises:
        BackendError: Another device, or what the device needs is missing.
    """
    if device == "cpu":
        return NativeCompute()
    return TorchCompute(device, make_rasterizer(device))
