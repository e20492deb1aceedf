"""Image loss of Gaussian training: L1 and structural dissimilarity in one native pass."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from aomgen.splatting import native


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
        BackendError: The engine is missing or refuses the arguments.
        TypeError: A tensor is not float32 on the CPU; the engine reads by address.
    """
    for tensor in (rendered, target) if gains is None else (rendered, target, gains):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(f"want float32 tensors on the CPU, got {tensor.dtype} on {tensor.device}")
    if gains is not None and gains.shape != rendered.shape[:1]:
        raise ValueError(f"gains have shape {tuple(gains.shape)}, want ({len(rendered)},)")
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
