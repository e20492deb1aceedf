"""Training of affinity features from masks of many views.

In each step the features are drawn into one view, pixels are sampled, and a size. Pixels that share
a mask up to that size are pulled together; pixels that a mask of about that size separates are pushed
apart; other pairs inside a larger mask are pulled weakly. Geometry and colors are frozen.

Source: SAGA (Cen et al., AAAI 2025), sec. 3.2-3.3. Differs in the pairs: there, a pair without a common
mask is always pushed apart, which asks for masks at every level in every view. A segmenter that
gives one mask a point does not have them.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.errors import ReconstructionError
from aomgen.parts.affinity import Affinity, SizedMasks, relative_sizes
from aomgen.splatting.compute import make_rasterizer
from aomgen.splatting.differentiable import GaussianTensors, Rasterizer, RasterOptions

STAGE = "affinity"
# Gaussians, itself included, whose mean feature each one is rendered with: local smoothing against noise.
NEIGHBORS = 8
# Masks within this factor (a power of two) below the sampled size separate.
OCTAVES = 0.5
# Weight of pairs that no mask separates and only a larger mask joins: far below that of certain pairs.
WEAK_WEIGHT = 0.05
# Weight of the regularization that makes all Gaussians on a ray agree.
NORM_WEIGHT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class AffinityParams:
    """Effort and weights.

    Attributes:
        channels: D, length of a feature.
        iterations: Steps; one view each.
        pixels: Pixels sampled a step.
        width: Width of the drawn features, [px].
        rate: Learning rate of the features; gates learn ten times slower.
        seed: Of first features and samples.
        device: "cpu" or "cuda".
    """

    channels: int = 32
    iterations: int = 300
    pixels: int = 600
    width: int = 200
    rate: float = 0.02
    seed: int = 0
    device: str = "cpu"


def train_affinity(
    gaussians: Gaussians, views: Sequence[SizedMasks], progress: Progress, params: AffinityParams
) -> Affinity:
    """Features of all Gaussians from the masks of some views.

    Args:
        gaussians: N Gaussians, world frame.
        views: Masks; one without any is left out.
        progress: Called now and then.
        params: Effort and weights.

    Raises:
        ReconstructionError: There are fewer than two masks.
        BackendError: The rasterizer is missing or refuses the scene.
    """
    views = [view for view in views if len(view.masks)]
    sizes = np.sort(np.concatenate([view.sizes_m for view in views])) if views else np.zeros(0)
    if not len(sizes) >= 2:
        raise ReconstructionError(
            STAGE, f"{len(sizes)} masks were found, want 2", "check the weights of the segmenter"
        )
    rng = np.random.default_rng(params.seed)
    draw = make_rasterizer(params.device)
    scene = _freeze(gaussians, params.device)
    mean = _neighbor_mean(gaussians, params)
    values = rng.normal(0, 1 / np.sqrt(params.channels), (len(gaussians), params.channels))
    features = torch.tensor(values, dtype=torch.float32, device=params.device, requires_grad=True)
    # Half of the channels start out for small things, half for large ones.
    gates = torch.linspace(-2, 2, params.channels, device=params.device)
    slopes, offsets = (4 * gates).requires_grad_(), (-2 * gates + 1).requires_grad_()
    optimizer = torch.optim.Adam(
        [{"params": [features], "lr": params.rate}, {"params": [slopes, offsets], "lr": 0.1 * params.rate}],
        betas=(0.9, 0.99),
    )
    sum_of_losses = 0.0
    for step in range(params.iterations):
        view = views[int(rng.integers(len(views)))]
        # A size of the view's own masks: other sizes have little to tell apart there.
        size = float(rng.choice(view.sizes_m))
        gate = torch.sigmoid(slopes * float(relative_sizes(np.array([size]), sizes)[0]) + offsets)
        pixels = _sample_pixels(view, size, params, rng)
        seen = _render_features(draw, scene, view, mean(features))[pixels]
        loss = _pair_loss(seen, gate, view, pixels, size)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        sum_of_losses += loss.item()
        if (step + 1) % 20 == 0 or step + 1 == params.iterations:
            progress((step + 1) / params.iterations, f"affinity loss {sum_of_losses / 20:.3f}")
            sum_of_losses = 0.0
    with torch.no_grad():
        smooth = mean(features)
    return Affinity(
        features=smooth.cpu().numpy(),
        gate_slopes=slopes.detach().cpu().numpy(),
        gate_offsets=offsets.detach().cpu().numpy(),
        sizes_m=sizes,
    )


def _freeze(gaussians: Gaussians, device: str) -> GaussianTensors:
    g = gaussians.with_sh_degree(0)
    opacities = np.clip(g.opacities, 1e-6, 1 - 1e-6)
    arrays = (g.means, g.quats, np.log(g.scales), np.log(opacities / (1 - opacities)), g.sh)
    means, quats, log_scales, logits, sh = (torch.tensor(array, device=device) for array in arrays)
    return GaussianTensors(means=means, quats=quats, log_scales=log_scales, logit_opacities=logits, sh=sh)


def _render_features(draw: Rasterizer, scene: GaussianTensors, view: SizedMasks, features: Tensor) -> Tensor:
    """Features (H * W, D) of a view, relative to what hides the background."""
    with_features = GaussianTensors(
        means=scene.means,
        quats=scene.quats,
        log_scales=scene.log_scales,
        logit_opacities=scene.logit_opacities,
        sh=scene.sh,
        features=features,
    )
    image = draw(with_features, view.camera, RasterOptions(sh_degree=0))
    if image.features is None:
        raise ReconstructionError(STAGE, "the rasterizer drew no features", "rebuild the engine")
    return (image.features / image.alpha.detach().clamp_min(1e-3)[..., None]).flatten(0, 1)


def _sample_pixels(
    view: SizedMasks, size_m: float, params: AffinityParams, rng: np.random.Generator
) -> np.ndarray:
    """Indices of masked pixels; half of them evenly over the masks of about the size, so that small things count."""
    flat = view.masks.reshape(len(view.masks), -1)
    masked = np.flatnonzero(flat.any(0))
    near = np.flatnonzero(_about(view.sizes_m, size_m, OCTAVES))
    if not len(near):
        near = np.arange(len(flat))
    share = max(1, params.pixels // (2 * len(near)))
    chosen = [rng.choice(np.flatnonzero(flat[index]), share) for index in near]
    rest = max(1, params.pixels - share * len(near))
    return np.unique(np.concatenate([*chosen, rng.choice(masked, rest)]))


def _about(sizes_m: np.ndarray, size_m: float, octaves: float) -> np.ndarray:
    # A hundredth on top, so that the mask whose size was sampled counts as that large.
    return (sizes_m <= 1.01 * size_m) & (sizes_m >= size_m * 2.0**-octaves)


def pair_evidence(
    masks: np.ndarray, sizes_m: np.ndarray, size_m: float, octaves: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which pairs of pixels the masks of a view join or separate at a size.

    Args:
        masks: (M, P), whether each pixel lies in each mask.
        sizes_m: (M,), [m].
        size_m: The size asked for, [m].
        octaves: Masks this far below the size still separate.

    Returns:
        together (P, P): They share a mask up to the size.
        apart (P, P): Not together, and a mask of about the size holds one of them only, or the
            smallest larger masks around them differ.
        perhaps (P, P): Neither, and the same mask is the smallest larger one around both.
    """
    small = masks[sizes_m <= 1.01 * size_m].astype(np.float32)
    near = masks[_about(sizes_m, size_m, octaves)].astype(np.float32)
    together = small.T @ small > 0
    one_only = near.T @ (1 - near) > 0
    around = np.full(masks.shape[1], -1)
    for index in np.argsort(-sizes_m):
        if sizes_m[index] > 1.01 * size_m:
            around[masks[index]] = index
    same = around[:, None] == around
    apart = (one_only | one_only.T | ~same) & ~together
    return together, apart, same & (around >= 0) & ~together & ~apart


def _pair_loss(seen: Tensor, gate: Tensor, view: SizedMasks, pixels: np.ndarray, size_m: float) -> Tensor:
    flat = view.masks.reshape(len(view.masks), -1)[:, pixels]
    evidence = pair_evidence(flat, view.sizes_m, size_m, OCTAVES)
    together, apart, perhaps = (torch.from_numpy(item).to(seen.device) for item in evidence)
    gated = torch.nn.functional.normalize(seen * gate, dim=1, eps=1e-6)
    cosines = gated @ gated.T
    loss = NORM_WEIGHT * (1 - seen.norm(dim=1)).clamp_min(0).mean()
    if together.any():
        loss = loss + (1 - cosines)[together].mean()
    if apart.any():
        loss = loss + cosines.clamp_min(0)[apart].mean()
    if perhaps.any():
        loss = loss + WEAK_WEIGHT * (1 - cosines)[perhaps].mean()
    return loss


class _NeighborMean:
    """Unit features of the Gaussians averaged over their nearest neighbors."""

    def __init__(self, forward: Tensor, backward: Tensor) -> None:
        self._forward, self._backward = forward, backward

    def __call__(self, features: Tensor) -> Tensor:
        directions = torch.nn.functional.normalize(features, dim=1, eps=1e-6)
        result: Any = _Sparse.apply(directions, self._forward, self._backward)
        return result


class _Sparse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:  # type: ignore[override]
        features, matrix, transposed = arguments
        ctx.transposed = transposed
        return matrix @ features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> tuple[Any, ...]:  # type: ignore[override]
        return ctx.transposed @ grads[0], None, None


def _neighbor_mean(gaussians: Gaussians, params: AffinityParams) -> _NeighborMean:
    from scipy.sparse import csr_matrix

    count = len(gaussians)
    k = min(NEIGHBORS, count)
    _, nearest = cKDTree(gaussians.means).query(gaussians.means, k=k)
    nearest = np.asarray(nearest).reshape(count, k)
    rows = np.arange(0, k * count + 1, k)
    matrix = csr_matrix((np.full(k * count, 1 / k, np.float32), nearest.ravel(), rows), (count, count))
    tensors = []
    for item in (matrix, matrix.T.tocsr()):
        arrays = (item.indptr.astype(np.int64), item.indices.astype(np.int64), item.data)
        with warnings.catch_warnings():
            # torch tells every process once that sparse tensors are young and unchecked.
            warnings.simplefilter("ignore", UserWarning)
            tensor = torch.sparse_csr_tensor(*map(torch.from_numpy, arrays), size=item.shape)
        tensors.append(tensor.to(params.device))
    return _NeighborMean(tensors[0], tensors[1])
