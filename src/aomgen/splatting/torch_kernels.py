"""Image loss and Adam step in plain torch: the twins of the engine's, for tensors on a GPU."""

import torch
from torch import Tensor
from torch.nn.functional import conv2d

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_MEAN_DECAY, _SQUARE_DECAY, _EPSILON = 0.9, 0.999, 1e-15


def image_loss(
    rendered: Tensor, target: Tensor, *, gains: Tensor | None = None, dssim_weight: float = 0.2
) -> Tensor:
    """(1 - w) * mean|g x - y| + w * (1 - SSIM(g x, y)), differentiable by x and g.

    SSIM uses an 11x11 Gaussian window of sigma 1.5 and zeros outside the image, as 3DGS does.

    Args:
        rendered: x, (C, H, W) float, any device.
        target: y, (C, H, W), same device and type.
        gains: g, (C,), a factor for every channel (exposure).
        dssim_weight: w, 0..1.

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
    luminance = (2 * u * v + _C1) / (u * u + v * v + _C1)
    structure = (2 * (xy - u * v) + _C2) / (xx - u * u + yy - v * v + _C2)
    return luminance * structure


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes (M, H, W), one axis after the other.

    One group for every plane: grouped convolutions run in full float32, where an ungrouped one would be
    rounded to TF32 on recent GPUs, more coarsely than the variances of smooth windows can bear.
    """
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, device=planes.device, dtype=planes.dtype)
    taps = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    taps = (taps / taps.sum()).expand(len(planes), 1, -1)
    rows = conv2d(planes[None], taps[:, :, None, :], padding=(0, _RADIUS), groups=len(planes))
    return conv2d(rows, taps[:, :, :, None], padding=(_RADIUS, 0), groups=len(planes))[0]


@torch.no_grad()
def adam_step(
    values: Tensor, gradient: Tensor, average: Tensor, square: Tensor, rates: Tensor, step: int
) -> None:
    """Change values, average and square in place.

    Args:
        values: (N, ...) of C numbers a row.
        gradient: Of the loss by the values, same shape.
        average, square: Running moments of the gradient, same shape.
        rates: (C,) learning rate of every number of a row, same device.
        step: Counted from 1.

    Source: Kingma & Ba 2015, arXiv:1412.6980, algorithm 1.
    """
    if step < 1:
        raise ValueError(f"step {step}, want 1 or more")
    average.lerp_(gradient, 1 - _MEAN_DECAY)
    square.mul_(_SQUARE_DECAY).addcmul_(gradient, gradient, value=1 - _SQUARE_DECAY)
    spread = square.div(1 - _SQUARE_DECAY**step).sqrt_().add_(_EPSILON)
    scaled = average.div(1 - _MEAN_DECAY**step).div_(spread)
    values.sub_(scaled.mul_(rates.view(values.shape[1:])))
