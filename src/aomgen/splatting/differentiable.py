"""The rasterizer as a differentiable torch function, in the optimizer's parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.splatting import native
from aomgen.splatting.rasterizer import native_view


@dataclass(frozen=True, slots=True, kw_only=True)
class TensorRendering:
    """Planar float32 images.

    Attributes:
        rgb: (3, H, W), not clipped above.
        depth: (H, W), sum of weight times depth (not divided by alpha), [m].
        alpha: (H, W).
    """

    rgb: Tensor
    depth: Tensor
    alpha: Tensor


def render_tensors(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    *,
    sh_degree: int,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    context: native.Context | None = None,
) -> TensorRendering:
    """Draw Gaussians and record what the gradients need.

    Args:
        means: (N, 3) float32.
        quats: (N, 4) float32, wxyz, normalised inside.
        log_scales: (N, 3) float32, logarithms of standard deviations.
        logit_opacities: (N,) float32.
        sh: (N, K, 3) float32.
        camera: View in the frame of the means.
        sh_degree: Degree that is evaluated, at most that of K.
        background: sRGB color 0..1.
        context: Engine memory to use; the backward pass must come before its next use. A new
            one by default, which is slow in a loop.

    Raises:
        BackendError: The engine is missing or refuses the scene, or `context` was used again
            before the backward pass.
    """
    context = context or native.Context()
    view = native_view(camera, background)
    rgb, depth, alpha = _Rasterize.apply(
        means, quats, log_scales, logit_opacities, sh, view, sh_degree, context
    )  # type: ignore[misc]
    return TensorRendering(rgb=rgb, depth=depth, alpha=alpha)


class _Rasterize(torch.autograd.Function):
    """Logs and logits become real values here; the engine differentiates by real values."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        view: native.View,
        sh_degree: int,
        context: native.Context,
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, quats, sh = (_plain(tensor) for tensor in (means, quats, sh))
        scales, opacities = _plain(log_scales).exp(), _plain(logit_opacities).sigmoid()
        scene = native.Scene(
            count=len(means),
            sh_coefficients=sh.shape[1],
            sh_degree=sh_degree,
            means=means.data_ptr(),
            quats=quats.data_ptr(),
            scales=scales.data_ptr(),
            opacities=opacities.data_ptr(),
            sh=sh.data_ptr(),
        )
        rgb = torch.empty((3, view.height, view.width))
        depth, alpha = torch.empty(rgb.shape[1:]), torch.empty(rgb.shape[1:])
        images = native.Images(rgb=rgb.data_ptr(), depth=depth.data_ptr(), alpha=alpha.data_ptr())
        context.forward(scene, view, images)
        ctx.context, ctx.forward_number = context, context.forward_number
        ctx.save_for_backward(means, quats, scales, opacities, sh, rgb, depth)
        return rgb, depth, alpha

    @staticmethod
    def backward(ctx: Any, grad_rgb: Tensor, grad_depth: Tensor, grad_alpha: Tensor) -> tuple:  # type: ignore[override]
        means, quats, scales, opacities, sh, rgb, depth = ctx.saved_tensors
        grads = [torch.empty_like(tensor) for tensor in (means, quats, scales, opacities, sh)]
        grad_images = [tensor.contiguous() for tensor in (grad_rgb, grad_depth, grad_alpha)]
        images = native.ImageGradients(
            rgb=rgb.data_ptr(),
            depth=depth.data_ptr(),
            grad_rgb=grad_images[0].data_ptr(),
            grad_depth=grad_images[1].data_ptr(),
            grad_alpha=grad_images[2].data_ptr(),
        )
        names = ("means", "quats", "scales", "opacities", "sh")
        addresses = {name: grad.data_ptr() for name, grad in zip(names, grads, strict=True)}
        ctx.context.backward(images, native.SceneGradients(**addresses), ctx.forward_number)
        by_log_scales = grads[2].mul_(scales)
        by_logits = grads[3].mul_(opacities * (1 - opacities))
        return grads[0], grads[1], by_log_scales, by_logits, grads[4], None, None, None


def _plain(tensor: Tensor) -> Tensor:
    if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
        raise TypeError(f"want float32 tensors on the CPU, got {tensor.dtype} on {tensor.device}")
    return tensor.detach().contiguous()
