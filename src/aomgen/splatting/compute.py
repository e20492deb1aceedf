"""Computations of the training on its device: rasterizer, image loss and optimizer steps.

On a CPU, the engine performs all of them. On a GPU, gsplat rasterizes, and loss and Adam are equivalent torch functions.
"""

from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from aomgen.errors import BackendError
from aomgen.splatting import native
from aomgen.splatting.differentiable import CpuRasterizer, Rasterizer
from aomgen.splatting.gsplat_backend import GsplatRasterizer


class Compute(Protocol):
    """Computations on one device; all tensors that its methods receive must be on `device`."""

    device: str
    draw: Rasterizer

    def image_loss(self, rendered: Tensor, target: Tensor, *, gains: Tensor | None) -> Tensor:
        """Compute L1 and D-SSIM; see the function `image_loss`."""
        ...

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        """Perform a step of Adam in place; see `torch_adam_step`."""
        ...


class NativeCompute:
    """Computations by the engine on the CPU; implements `Compute`."""

    device = "cpu"

    def __init__(self) -> None:
        self._context = native.Context()
        self.draw: Rasterizer = CpuRasterizer(self._context)

    def image_loss(self, rendered: Tensor, target: Tensor, *, gains: Tensor | None) -> Tensor:
        return image_loss(rendered, target, gains=gains, context=self._context)

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        native_adam_step(self._context, values, gradient, moments, rates, step)


class TorchCompute:
    """Computations by torch and a rasterizer on any device; implements `Compute`."""

    def __init__(self, device: str, draw: Rasterizer) -> None:
        self.device, self.draw = device, draw

    def image_loss(self, rendered: Tensor, target: Tensor, *, gains: Tensor | None) -> Tensor:
        return torch_image_loss(rendered, target, gains=gains)

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        torch_adam_step(values, gradient, *moments, rates, step)


def make_compute(device: str) -> Compute:
    """Create the computations of a device: the engine for "cpu", torch and gsplat for "cuda".

    Raises:
        BackendError: The device is unknown, or a dependency of the device is missing.
    """
    if device == "cpu":
        return NativeCompute()
    return TorchCompute(device, make_rasterizer(device))


def make_rasterizer(device: str) -> Rasterizer:
    """Create a differentiable rasterizer: the engine for tensors on "cpu", gsplat for tensors on "cuda".

    Raises:
        BackendError: The device is unknown, or a dependency of the device is missing.
    """
    if device == "cpu":
        return CpuRasterizer()
    if device == "cuda":
        return GsplatRasterizer()
    raise BackendError("rasterizer", f"device '{device}' is unknown", "choose one of: cpu, cuda")


def image_loss(
    rendered: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    dssim_weight: float = 0.2,
    context: native.Context | None = None,
) -> Tensor:
    """Compute the image loss (1 - w) * mean|g x - y| + w * (1 - SSIM(g x, y)).

    SSIM uses an 11x11 Gaussian window of sigma 1.5 and zeros outside the image, as 3DGS does.

    Args:
        rendered: Rendered image x, (C, H, W) float32.
        target: Target image y, (C, H, W) float32; it receives no gradient.
        gains: Factor g of each channel (exposure), (C,) float32.
        dssim_weight: Weight w of D-SSIM, 0..1.
        context: Context of the engine; may be that of the rasterizer. None creates a new one.

    Returns:
        Scalar float32, differentiable with respect to x and g.

    Raises:
        TypeError: A tensor is not float32 on the CPU, which the engine requires.
        ValueError: The shapes do not match.
    """
    for tensor in (rendered, target) if gains is None else (rendered, target, gains):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(f"expected float32 tensors on the CPU, got {tensor.dtype} on {tensor.device}")
    if gains is not None and gains.shape != rendered.shape[:1]:
        raise ValueError(f"gains have shape {tuple(gains.shape)}, expected ({len(rendered)},)")
    if rendered.shape != target.shape or rendered.ndim != 3:
        raise ValueError(f"images have shapes {tuple(rendered.shape)} and {tuple(target.shape)}")
    return _ImageLoss.apply(rendered, target, gains, dssim_weight, context or native.Context())  # type: ignore[return-value]


class _ImageLoss(torch.autograd.Function):
    """Image loss of the engine, which computes the gradients in the forward pass; the backward pass scales them."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        rendered: Tensor,
        target: Tensor,
        gains: Tensor | None,
        dssim_weight: float,
        context: native.Context,
    ) -> Tensor:
        rendered, target = rendered.detach().contiguous(), target.detach().contiguous()
        gains = None if gains is None else gains.detach().contiguous()
        by_rendered = torch.empty_like(rendered)
        by_gains = None if gains is None else torch.empty_like(gains)
        channels, height, width = rendered.shape
        loss = context.image_loss(
            (channels, height, width),
            (rendered.data_ptr(), target.data_ptr()),
            None if gains is None else gains.data_ptr(),
            dssim_weight,
            (by_rendered.data_ptr(), None if by_gains is None else by_gains.data_ptr()),
        )
        ctx.save_for_backward(by_rendered, by_gains)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple:  # type: ignore[override]
        by_rendered, by_gains = ctx.saved_tensors
        return grad * by_rendered, None, None if by_gains is None else grad * by_gains, None, None


def torch_image_loss(
    rendered: Tensor, target: Tensor, *, gains: Tensor | None = None, dssim_weight: float = 0.2
) -> Tensor:
    """Compute `image_loss` with torch, for floating-point tensors on any device.

    Source: Wang et al. 2004, doi:10.1109/TIP.2003.819861; Kerbl et al. 2023, eq. 7.
    """
    if rendered.shape != target.shape or rendered.ndim != 3:
        raise ValueError(f"images have shapes {tuple(rendered.shape)} and {tuple(target.shape)}")
    x = rendered if gains is None else rendered * gains[:, None, None]
    loss = (1 - dssim_weight) * (x - target).abs().mean()
    return loss + dssim_weight * (1 - _ssim(x, target).mean()) if dssim_weight else loss


def _ssim(x: Tensor, y: Tensor) -> Tensor:
    """Compute the structural similarity (C, H, W) of each channel and window."""
    u, v, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * u * v + c1) / (u * u + v * v + c1)
    structure = (2 * (xy - u * v) + c2) / (xx - u * u + yy - v * v + c2)
    return luminance * structure


def _blur(planes: Tensor) -> Tensor:
    """Convolve planes (M, H, W) with the Gaussian window, one axis after the other.

    Each plane is a group of the convolution, because grouped convolutions are computed in full float32. Recent GPUs round
    ungrouped ones to TF32, whose error exceeds the variances of smooth windows.
    """
    radius, sigma = 5, 1.5
    offsets = torch.arange(-radius, radius + 1, device=planes.device, dtype=planes.dtype)
    taps = torch.exp(-(offsets**2) / (2 * sigma**2))
    taps = (taps / taps.sum()).expand(len(planes), 1, -1)
    rows = conv2d(planes[None], taps[:, :, None, :], padding=(0, radius), groups=len(planes))
    return conv2d(rows, taps[:, :, :, None], padding=(radius, 0), groups=len(planes))[0]


def native_adam_step(
    context: native.Context,
    values: Tensor,
    gradient: Tensor,
    moments: tuple[Tensor, Tensor],
    rates: Tensor,
    step: int,
) -> None:
    """Perform `torch_adam_step` with the engine, for contiguous float32 tensors on the CPU."""
    columns = values[0].numel() if len(values) else 1
    tensors = (values, gradient.contiguous(), *moments, rates)
    context.adam_step((len(values), columns), tuple(tensor.data_ptr() for tensor in tensors), step)


@torch.no_grad()
def torch_adam_step(
    values: Tensor, gradient: Tensor, average: Tensor, square: Tensor, rates: Tensor, step: int
) -> None:
    """Perform a step of Adam in place.

    Args:
        values: Parameters (N, ...), changed in place.
        gradient: Gradient of the loss with respect to `values`.
        average: First moment of the gradient, changed in place.
        square: Second moment of the gradient, changed in place.
        rates: Learning rate (C,) of each of the C numbers of a row of `values`.
        step: Number of this step, from 1.

    Raises:
        ValueError: `step` is less than 1.

    Source: Kingma & Ba 2015, arXiv:1412.6980, algorithm 1.
    """
    if step < 1:
        raise ValueError(f"step {step}, expected 1 or more")
    mean_decay, square_decay = 0.9, 0.999
    average.lerp_(gradient, 1 - mean_decay)
    square.mul_(square_decay).addcmul_(gradient, gradient, value=1 - square_decay)
    spread = square.div(1 - square_decay**step).sqrt_().add_(1e-15)
    scaled = average.div(1 - mean_decay**step).div_(spread)
    values.sub_(scaled.mul_(rates.view(values.shape[1:])))
