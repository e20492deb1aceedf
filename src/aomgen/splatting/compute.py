"""Computations of the training on its device: rasterizer, image loss and steps of the optimizer.

On the processor the engine does all of it; for tensors on a GPU, loss and Adam have twins in plain torch.
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
    """Tensors given to its functions are on `device`."""

    device: str
    draw: Rasterizer

    def image_loss(self, rendered: Tensor, target: Tensor, *, gains: Tensor | None) -> Tensor:
        """L1 and D-SSIM, see the function `image_loss`."""
        ...

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        """Adam in place, see `torch_adam_step`."""
        ...


class NativeCompute:
    """The engine, on the processor; implements `Compute`."""

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
    """Plain torch around a rasterizer, on its device; implements `Compute`."""

    def __init__(self, device: str, draw: Rasterizer) -> None:
        self.device, self.draw = device, draw

    def image_loss(self, rendered: Tensor, target: Tensor, *, gains: Tensor | None) -> Tensor:
        return torch_image_loss(rendered, target, gains=gains)

    def adam_step(
        self, values: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], rates: Tensor, step: int
    ) -> None:
        torch_adam_step(values, gradient, *moments, rates, step)


def make_compute(device: str) -> Compute:
    """The engine for "cpu", torch and gsplat for "cuda"; raises as `make_rasterizer`."""
    if device == "cpu":
        return NativeCompute()
    return TorchCompute(device, make_rasterizer(device))


def make_rasterizer(device: str) -> Rasterizer:
    """The engine for tensors on "cpu", gsplat for tensors on "cuda".

    Raises:
        BackendError: Another device, or what the device needs is missing.
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
    """(1 - w) * mean|g x - y| + w * (1 - SSIM(g x, y)), differentiable by x and g.

    SSIM uses an 11x11 Gaussian window of sigma 1.5 and zeros outside the image, as 3DGS does.

    Args:
        rendered: x, (C, H, W) float32.
        target: y, (C, H, W) float32, no gradient.
        gains: g, (C,) float32, a factor for every channel (exposure).
        dssim_weight: w, 0..1.
        context: Engine memory to use; may be the one of the rasterizer.

    Raises:
        TypeError: A tensor is not float32 on the CPU; the engine reads by address.
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
    """The engine gives the loss and its gradients at once; backward only scales them."""

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
    """As `image_loss`, for floats on any device.

    Source: Wang et al. 2004, doi:10.1109/TIP.2003.819861; Kerbl et al. 2023, eq. 7.
    """
    if rendered.shape != target.shape or rendered.ndim != 3:
        raise ValueError(f"images have shapes {tuple(rendered.shape)} and {tuple(target.shape)}")
    x = rendered if gains is None else rendered * gains[:, None, None]
    loss = (1 - dssim_weight) * (x - target).abs().mean()
    return loss + dssim_weight * (1 - _ssim(x, target).mean()) if dssim_weight else loss


def _ssim(x: Tensor, y: Tensor) -> Tensor:
    """Structural similarity (C, H, W) of every channel and window."""
    u, v, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * u * v + c1) / (u * u + v * v + c1)
    structure = (2 * (xy - u * v) + c2) / (xx - u * u + yy - v * v + c2)
    return luminance * structure


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes (M, H, W), one axis after the other.

    One group for every plane: grouped convolutions run in full float32, where an ungrouped one would be
    rounded to TF32 on recent GPUs, more coarsely than the variances of smooth windows can bear.
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
    """As `torch_adam_step`, by the engine."""
    columns = values[0].numel() if len(values) else 1
    tensors = (values, gradient.contiguous(), *moments, rates)
    context.adam_step((len(values), columns), tuple(tensor.data_ptr() for tensor in tensors), step)


@torch.no_grad()
def torch_adam_step(
    values: Tensor, gradient: Tensor, average: Tensor, square: Tensor, rates: Tensor, step: int
) -> None:
    """Change values (N, ...) and the running moments of their gradient in place; `step` counts from 1.

    `rates` (C,) has a learning rate for each of the C numbers of a row.

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
