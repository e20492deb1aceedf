"""Median depth and largest contribution, read from lists of pairs."""

import numpy as np
import torch

from aomgen.splatting.gsplat_backend import median_depth_and_max_id


def test_random_lists_are_read_like_loops() -> None:
    rng = np.random.default_rng(0)
    count, shape, depths = 30, (7, 9), rng.uniform(0.5, 4, 30)
    pixels, gaussians, alphas = [], [], []
    want_depth, want_id = np.zeros(63), np.full(63, -1)
    for pixel in range(63):
        left, best = 1.0, 0.0
        listed = rng.permutation(count)[: rng.integers(0, 6)]
        for gaussian in sorted(listed, key=lambda one: depths[one]):
            alpha = rng.choice([0.1, 0.3, 0.6, 0.999])
            pixels.append(pixel)
            gaussians.append(gaussian)
            alphas.append(alpha)
            if left * alpha > best + 1e-12:
                best, want_id[pixel] = left * alpha, gaussian
            left *= 1 - alpha
            if left < 0.5 and not want_depth[pixel]:
                want_depth[pixel] = depths[gaussian]
    have_depth, have_id = median_depth_and_max_id(
        torch.tensor(pixels), torch.tensor(gaussians), torch.tensor(alphas), torch.tensor(depths), shape
    )
    assert (want_id < 0).sum() > 3
    assert ((want_depth == 0) & (want_id >= 0)).sum() > 3
    assert (have_depth.dtype, have_id.dtype) == (torch.float32, torch.int32)
    np.testing.assert_array_equal(have_id, want_id.reshape(shape))
    np.testing.assert_allclose(have_depth, want_depth.reshape(shape), rtol=1e-6)


def test_the_nearest_of_equals_counts() -> None:
    pixels, gaussians = torch.tensor([1, 1]), torch.tensor([5, 2])
    _, max_id = median_depth_and_max_id(
        pixels, gaussians, torch.tensor([0.2, 0.25]), torch.arange(6.0), (1, 2)
    )
    assert max_id.tolist() == [[-1, 5]]


def test_no_pairs() -> None:
    nothing = torch.zeros(0, dtype=torch.int64)
    depth, max_id = median_depth_and_max_id(nothing, nothing, torch.zeros(0), torch.zeros(0), (2, 3))
    assert torch.equal(depth, torch.zeros(2, 3))
    assert torch.equal(max_id, torch.full((2, 3), -1, dtype=torch.int32))


def test_long_lists_keep_their_precision() -> None:
    """A million pairs before a pixel do not blur its light."""
    many = 1_000_000
    pixels = torch.cat([torch.zeros(many, dtype=torch.int64), torch.ones(2, dtype=torch.int64)])
    gaussians = torch.cat([torch.zeros(many, dtype=torch.int64), torch.tensor([1, 2])])
    alphas = torch.cat([torch.full((many,), 0.9), torch.tensor([0.4999, 0.001])])
    depth, max_id = median_depth_and_max_id(pixels, gaussians, alphas, torch.arange(3.0), (1, 2))
    assert max_id.tolist() == [[0, 1]]
    assert depth[0, 1] == 2
