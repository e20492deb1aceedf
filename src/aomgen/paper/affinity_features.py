"""Affinity features, which group Gaussians into parts of a chosen size. [paper 4.1]

Every Gaussian has a feature. A gate that depends on the requested size weights its channels, and two Gaussians belong together at
that size if their gated features have similar directions. In each training step, the features are rendered into one view, and
pixels and a size are sampled. The loss increases the similarity of pixels that share a mask up to that size, reduces it for pixels
that a mask of about that size separates, and weakly increases it for other pairs inside a larger mask. Geometry and colors are
constant.

Source: SAGA (Cen et al., Segment Any 3D Gaussians, AAAI 2025), sec. 3.1-3.3; own code. The pairs differ:
there, the similarity of a pair without a common mask is always reduced, which requires masks at every level in every view. A
segmenter that returns one mask for each point does not provide them.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import ReconstructionError
from aomgen.segmentation.interface import Mask
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions
from aomgen.splatting.optimizer import parameters_of
from aomgen.splatting.surfaces import compute_surface_points

# Number of neighboring Gaussians, including itself, over which the feature of each is averaged, to reduce noise.
NEIGHBORS = 8
# Least size of a separating mask, as a share of the sampled size: half an octave.
LEAST_SHARE = 0.5**0.5
# Weight of pairs that no mask separates and only a larger mask joins: much smaller than that of certain pairs.
WEAK_WEIGHT = 0.05
# Weight of the regularization that makes all Gaussians on a ray agree.
NORM_WEIGHT = 0.2
# Learning rate of the features, which have about unit length; gates learn ten times slower.
RATE = 0.02
# Least number of pixels of a mask whose size is used.
MIN_PIXELS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class AffinityParams:
    """Effort of the training.

    Attributes:
        views: Number of segmented views, including the prompted ones.
        channels: Length D of a feature.
        iterations: Number of steps, each with one view.
        pixels: Number of sampled pixels in a step.
        width: Width of the rendered features, [px].
    """

    views: int = 12
    channels: int = 32
    iterations: int = 300
    pixels: int = 600
    width: int = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class SizedMasks:
    """Masks (M, H, W) of one view, without pixels that show nothing, and their sizes (M,), [m]."""

    camera: Camera
    masks: Annotated[NDArray[np.bool_], "M H W"]
    sizes_m: Annotated[Array, "M"]

    __post_init__ = freeze_arrays


# Function from a size, [m], to gated features (N, D), see `gate_features`.
FeaturesAt = Callable[[float], NDArray[np.float32]]


def gate_features(
    features: NDArray[np.float32], gates: Array, known_m: Array, size_m: float
) -> NDArray[np.float32]:
    """Compute gated features (N, D) of unit length at a size; zero for Gaussians without a feature.

    Args:
        features: Features of N Gaussians (N, D).
        gates: Slopes and offsets (2, D) of the gates over the relative size.
        known_m: Sizes of the masks (K,) of the training, ascending, [m]. The relative size is
            the rank among them, 0..1, so that gates do not depend on the scene's extent.
        size_m: Size, [m].
    """
    slopes, offsets = gates
    rank = relative_sizes(np.array([size_m]), known_m)[0]
    gate = 1 / (1 + np.exp(-(slopes * rank + offsets)))
    return unit(features * gate.astype(np.float32))


def relative_sizes(sizes_m: Array, known_m: Array) -> Array:
    """Compute the ranks 0..1 of sizes among known ones in ascending order, interpolated on a logarithmic scale."""
    distinct = np.unique(known_m)
    if len(distinct) < 2:
        return np.full(len(sizes_m), 0.5)
    return np.interp(np.log(sizes_m), np.log(distinct), np.linspace(0, 1, len(distinct)))


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normalize rows to length 1; rows of length 0 are kept."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)


def measure_masks(gaussians: Gaussians, camera: Camera, masks: NDArray[np.bool_], width: int) -> SizedMasks:
    """Select the masks (M, H, W) that are not empty at a width of at most `width` [px], and measure their sizes."""
    small = camera.narrow(width)
    points = compute_surface_points(gaussians, small)
    cut = at_resolution(masks, small) & np.isfinite(points[..., 0])
    kept = [index for index, mask in enumerate(cut) if mask.sum() >= MIN_PIXELS]
    sizes = np.array([mask_size(points[cut[index]]) for index in kept])
    return SizedMasks(camera=small, masks=cut[kept], sizes_m=sizes)


def at_resolution(masks: NDArray[np.bool_], camera: Camera) -> NDArray[np.bool_]:
    """Reduce masks (..., H, W) to the lower resolution of a camera."""
    height, width = masks.shape[-2:]
    rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
    return masks[..., rows, :][..., columns]


def mask_size(points_world: Array) -> float:
    """Compute twice the spread of the points (N, 3) that a mask shows, [m].

    The spread is that of the middle nine tenths along each axis, which excludes background pixels at the rim of the mask.
    """
    low, high = np.quantile(points_world, [0.05, 0.95], axis=0)
    inside = np.all((points_world >= low) & (points_world <= high), axis=1)
    kept = points_world[inside] if inside.sum() >= MIN_PIXELS else points_world
    return float(max(2 * np.linalg.norm(kept.std(axis=0)), 1e-6))


def train_affinity(
    gaussians: Gaussians,
    views: Sequence[SizedMasks],
    progress: Progress,
    params: AffinityParams,
    rng: np.random.Generator,
) -> FeaturesAt:
    """Train features of all Gaussians, world frame, on the masks of some views.

    Raises:
        ReconstructionError: There are fewer than two masks.
        BackendError: The rasterizer is missing or refuses the scene.
    """
    views = [view for view in views if len(view.masks)]
    sizes = np.sort(np.concatenate([view.sizes_m for view in views])) if views else np.zeros(0)
    if not len(sizes) >= 2:
        raise ReconstructionError(
            "affinity", f"{len(sizes)} masks were found, expected 2", "check the weights of the segmenter"
        )
    scene, smoothing = parameters_of(gaussians, 0).values, _neighbor_mean(gaussians)
    values = rng.normal(0, 1 / np.sqrt(params.channels), (len(gaussians), params.channels))
    features = torch.tensor(values, dtype=torch.float32, requires_grad=True)
    # Half of the channels are initialized for small masks, half for large ones.
    gates = torch.linspace(-2, 2, params.channels)
    slopes, offsets = (4 * gates).requires_grad_(), (-2 * gates + 1).requires_grad_()
    optimizer = torch.optim.Adam(
        [{"params": [features], "lr": RATE}, {"params": [slopes, offsets], "lr": 0.1 * RATE}],
        betas=(0.9, 0.99),
    )
    draw = CpuRasterizer()
    for step in range(params.iterations):
        view = views[int(rng.integers(len(views)))]
        # The size is that of a mask of the view, because at other sizes the view separates few pixels.
        size = float(rng.choice(view.sizes_m))
        gate = torch.sigmoid(slopes * float(relative_sizes(np.array([size]), sizes)[0]) + offsets)
        pixels = _sample_pixels(view, size, params.pixels, rng)
        smooth = torch.sparse.mm(smoothing, normalize(features, dim=1, eps=1e-6))
        image = draw(GaussianTensors(**scene, features=smooth), view.camera, RasterOptions(sh_degree=0))
        if image.features is None:
            raise ReconstructionError("affinity", "the rasterizer drew no features", "rebuild the engine")
        # The features are relative to the alpha of the Gaussians.
        seen = (image.features / image.alpha.detach().clamp_min(1e-3)[..., None]).flatten(0, 1)[pixels]
        loss = _pair_loss(seen, gate, view, pixels, size)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        if (step + 1) % 20 == 0 or step + 1 == params.iterations:
            progress((step + 1) / params.iterations, f"affinity loss {loss.item():.3f}")
    with torch.no_grad():
        smooth = torch.sparse.mm(smoothing, normalize(features, dim=1, eps=1e-6))
    learned = torch.stack([slopes, offsets]).detach().numpy().astype(np.float64)
    return partial(gate_features, smooth.numpy(), learned, sizes)


def _neighbor_mean(gaussians: Gaussians) -> Tensor:
    """Build the sparse matrix (N, N) of means over the nearest neighbors."""
    count = len(gaussians)
    k = min(NEIGHBORS, count)
    _, nearest = cKDTree(gaussians.means).query(gaussians.means, k=k)
    rows, columns = torch.arange(0, k * count + 1, k), torch.from_numpy(np.asarray(nearest).reshape(-1))
    with warnings.catch_warnings():
        # torch warns once in every process that sparse tensors are a beta feature and unchecked.
        warnings.simplefilter("ignore", UserWarning)
        return torch.sparse_csr_tensor(rows, columns, torch.full((k * count,), 1 / k), size=(count, count))


def _sample_pixels(view: SizedMasks, size_m: float, count: int, rng: np.random.Generator) -> NDArray:
    """Sample indices of masked pixels; half of them come evenly from the masks of about the size, so that small masks count."""
    flat = view.masks.reshape(len(view.masks), -1)
    near = np.flatnonzero(_about(view.sizes_m, size_m))
    share = max(1, count // (2 * len(near)))
    chosen = [rng.choice(np.flatnonzero(flat[index]), share) for index in near]
    rest = max(1, count - share * len(near))
    return np.unique(np.concatenate([*chosen, rng.choice(np.flatnonzero(flat.any(0)), rest)]))


def _about(sizes_m: Array, size_m: float) -> Mask:
    # The tolerance of 1 % includes the mask whose size was sampled.
    return (sizes_m <= 1.01 * size_m) & (sizes_m >= LEAST_SHARE * size_m)


def pair_evidence(masks: Mask, sizes_m: Array, size_m: float) -> tuple[Mask, Mask, Mask]:
    """Decide which pairs of pixels the masks of a view join or separate at a size.

    Args:
        masks: (M, P), whether each pixel is in each mask.

    Returns:
        together (P, P): The pixels share a mask up to the size.
        apart (P, P): They are not together, and a mask of about the size contains only one of them, or the smallest
            larger masks around them differ.
        perhaps (P, P): They are neither, and the same mask is the smallest larger one around both.
    """
    small = masks[sizes_m <= 1.01 * size_m].astype(np.float32)
    near = masks[_about(sizes_m, size_m)].astype(np.float32)
    together = small.T @ small > 0
    one_only = near.T @ (1 - near) > 0
    around = np.full(masks.shape[1], -1)
    for index in np.argsort(-sizes_m):
        if sizes_m[index] > 1.01 * size_m:
            around[masks[index]] = index
    same = around[:, None] == around
    apart = (one_only | one_only.T | ~same) & ~together
    return together, apart, same & (around >= 0) & ~together & ~apart


def _pair_loss(seen: Tensor, gate: Tensor, view: SizedMasks, pixels: NDArray, size_m: float) -> Tensor:
    flat = view.masks.reshape(len(view.masks), -1)[:, pixels]
    evidence = pair_evidence(flat, view.sizes_m, size_m)
    gated = normalize(seen * gate, dim=1, eps=1e-6)
    cosines = gated @ gated.T
    loss = NORM_WEIGHT * (1 - seen.norm(dim=1)).clamp_min(0).mean()
    distances = (1 - cosines, cosines.clamp_min(0), WEAK_WEIGHT * (1 - cosines))
    for pairs, distance in zip(evidence, distances, strict=True):
        if pairs.any():
            loss = loss + distance[torch.from_numpy(pairs)].mean()
    return loss
