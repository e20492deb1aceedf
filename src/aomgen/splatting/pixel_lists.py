"""Images read from the lists of Gaussians that the pixels blend, in torch."""

import torch
from torch import Tensor


@torch.no_grad()
def median_depth_and_max_id(
    pixels: Tensor, gaussians: Tensor, alphas: Tensor, depths: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Depth where less than half of the light is left, and the Gaussian of the largest weight.

    Args:
        pixels: (M,) row-major index of the pixel, ascending; within a pixel near to far.
        gaussians: (M,) index of the Gaussian.
        alphas: (M,) what it takes of the light, 0 <= alpha < 1.
        depths: (N,) of the Gaussians, [m].
        shape: Height and width of the images.

    Returns:
        Median depth, float32, 0 where half of the light gets through; largest contribution, int32, -1
        where nothing is drawn (the nearest of equals).
    """
    count = shape[0] * shape[1]
    depth = torch.zeros(count, dtype=torch.float32, device=depths.device)
    max_id = torch.full((count,), -1, dtype=torch.int32, device=depths.device)
    if len(pixels):
        left, weights = _light_left(pixels, alphas)
        largest = weights.new_zeros(count).scatter_reduce_(0, pixels, weights, "amax")
        which, first = _first_of_pixels(pixels, weights >= largest[pixels], count)
        max_id[which] = gaussians[first].int()
        which, first = _first_of_pixels(pixels, left < 0.5, count)
        depth[which] = depths[gaussians[first]].float()
    return depth.reshape(shape), max_id.reshape(shape)


def _light_left(pixels: Tensor, alphas: Tensor) -> tuple[Tensor, Tensor]:
    """Light left behind every pair (M,), and the pair's weight (M,), float64."""
    alphas = alphas.double()
    logs = torch.log1p(-alphas)
    sums = logs.cumsum(0)
    starts = torch.ones_like(pixels, dtype=torch.bool)
    starts[1:] = pixels[1:] != pixels[:-1]
    before = (sums - logs)[starts][starts.cumsum(0) - 1]
    return (sums - before).exp(), alphas * (sums - logs - before).exp()


def _first_of_pixels(pixels: Tensor, chosen: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Pixels that have a chosen pair, and the row of the first one."""
    rows = torch.arange(len(pixels), device=pixels.device)
    first = rows.new_full((count,), len(rows)).scatter_reduce_(0, pixels[chosen], rows[chosen], "amin")
    which = (first < len(rows)).nonzero()[:, 0]
    return which, first[which]
