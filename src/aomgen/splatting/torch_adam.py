"""Adam in plain torch: the twin of the engine's step, for tensors on a GPU."""

import torch
from torch import Tensor

_MEAN_DECAY, _SQUARE_DECAY, _EPSILON = 0.9, 0.999, 1e-15


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
