"""Deviation of the engine from float64, in images and in gradients."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting import native
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions, TensorRendering
from benchmarks.projection import PARAMETERS, parameters_of
from benchmarks.tiles_float64 import TileReference, choose_tiles, tile_mask


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Differences of the engine from float64 on some tiles.

    Forward errors are absolute, over red, green, blue, alpha (all 0..1) and depth divided by the
    largest depth drawn. Gradient errors are relative to the largest gradient of the same
    parameter, the worst of all parameters.

    Attributes:
        max_forward_error: Largest over all pixels of the tiles. Where alpha or the remaining light is at its
            limit, float32 and float64 draw different splats, up to 1/255.
        forward_error_p999: 99.9th percentile of the same errors.
        forward_error_decided: Largest over the pixels that rounding cannot change.
        max_gradient_error: Error for a loss with a random gradient on every pixel of the tiles.
        gradient_error_decided: Error for the same loss without the pixels that rounding can change.
        decided_share: Share of the tiles' pixels that rounding cannot change.
    """

    max_forward_error: float
    forward_error_p999: float
    forward_error_decided: float
    max_gradient_error: float
    gradient_error_decided: float
    decided_share: float


class Oracle:
    """Float64 images and gradients of one scene, for comparison with engine settings.

    Args:
        gaussians: The scene; its float32 values are taken as exact.
        camera: View.
        tiles: Number of compared tiles of the image, chosen at random.
        seed: Seed of the tiles and of the loss.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, tiles: int, seed: int = 0) -> None:
        self._camera, self._degree = camera, gaussians.sh_degree
        self._parameters = parameters_of(gaussians)
        chosen = choose_tiles(camera, tiles, seed)
        reference = TileReference(self._parameters, camera, self._degree, chosen)
        self._images = reference.images()
        self._mask = torch.tensor(tile_mask(camera, chosen))
        noise = np.random.default_rng(seed).normal(size=self._images.planes.shape)
        self._grad_planes = [torch.tensor(noise) * mask for mask in (self._mask, self._images.decided)]
        self._gradients = [reference.gradients(planes) for planes in self._grad_planes]

    def compare(self, context: native.Context) -> Agreement:
        """Measure the errors of the engine with a context's instruction set."""
        planes, gradients = zip(*(self._drawn(context, g) for g in self._grad_planes), strict=True)
        errors = (planes[0] - self._images.planes).abs()
        errors[3] /= self._images.planes[3].max()
        decided = self._images.decided
        by_loss = [
            max(_relative_error(have[name], want[name]) for name in PARAMETERS)
            for have, want in zip(gradients, self._gradients, strict=True)
        ]
        inside = errors[:, self._mask]
        return Agreement(
            max_forward_error=float(inside.max()),
            forward_error_p999=float(np.quantile(inside.numpy(), 0.999)),
            forward_error_decided=float(errors[:, decided].max()),
            max_gradient_error=by_loss[0],
            gradient_error_decided=by_loss[1],
            decided_share=float(decided.sum() / self._mask.sum()),
        )

    def _drawn(self, context: native.Context, grad_planes: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in self._parameters.items()}
        drawn = draw(leaves, self._camera, self._degree, context)
        planes = torch.cat([drawn.rgb, drawn.depth[None], drawn.alpha[None]])
        planes.backward(grad_planes.float())
        gradients = {}
        for name, leaf in leaves.items():
            assert leaf.grad is not None
            gradients[name] = leaf.grad.double()
        return planes.detach().double(), gradients


def draw(
    parameters: dict[str, Tensor], camera: Camera, degree: int, context: native.Context
) -> TensorRendering:
    """Render the engine's image over black from float32 tensors by the names in `PARAMETERS`."""
    rasterizer, options = CpuRasterizer(context), RasterOptions(sh_degree=degree)
    return rasterizer(GaussianTensors(**parameters), camera, options)


def _relative_error(have: Tensor, want: Tensor) -> float:
    return float((have - want).abs().max() / want.abs().max())
