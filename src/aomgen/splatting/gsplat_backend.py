"""Rasterizer on an NVIDIA GPU by gsplat, with the interface of the CPU rasterizer.

The conventions are those of `differentiable.Rasterizer`. Two constants of gsplat's kernels differ from those of the
engine, with a negligible effect on images: the largest alpha of a Gaussian is 0.999 (engine: 0.99), and the Gaussian
that reduces the transmittance below 1e-4 is not rendered (engine: rendered).
"""

from dataclasses import replace
from types import ModuleType

import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.splatting.differentiable import GaussianTensors, PartTensors, RasterOptions, TensorRendering
from aomgen.splatting.gsplat_inputs import (
    check_parts,
    check_scene,
    finite_only,
    load_gsplat,
    place_in_world,
    view_directions,
)

# Largest alpha of one Gaussian in gsplat.
MAX_ALPHA = 0.999
_DILATION = 0.1  # [px^2]


class GsplatRasterizer:
    """Rasterizer of Gaussians whose tensors are on a CUDA device, differentiable with respect to all tensors.

    It implements `Rasterizer`.

    Args:
        gsplat: Module of gsplat; None imports and checks the installed one.

    Raises:
        BackendError: gsplat or CUDA is missing, or gsplat's kernels do not build.
    """

    def __init__(self, gsplat: ModuleType | None = None) -> None:
        self._gsplat = load_gsplat() if gsplat is None else gsplat

    def __call__(
        self,
        gaussians: GaussianTensors,
        camera: Camera,
        options: RasterOptions,
        *,
        T_cam_world: Tensor | None = None,
        parts: PartTensors | None = None,
    ) -> TensorRendering:
        """Render as described in `Rasterizer`; Gaussians with NaN or infinite values are omitted."""
        check_scene(gaussians, camera, options.sh_degree)
        if parts is not None:
            check_parts(gaussians, parts)
        T_cam_world = _viewmat(camera, gaussians) if T_cam_world is None else T_cam_world.to(gaussians.means)
        background = gaussians.means.new_tensor(options.background)
        if not len(gaussians.means):
            return _nothing(gaussians, camera, background, options.with_ids)
        gaussians = finite_only(gaussians)
        directions = view_directions(gaussians.means, T_cam_world, parts)
        colors = self._gsplat.spherical_harmonics(options.sh_degree, directions, gaussians.sh)
        channels = (colors + 0.5).clamp_min(0)
        if gaussians.features is not None:
            channels = torch.cat([channels, gaussians.features], -1)
            background = torch.cat([background, background.new_zeros(gaussians.features.shape[1])])
        images, alphas, lists = self._rasterize(
            gaussians, (camera, T_cam_world, parts), options, (channels, background[None], "RGB+D")
        )
        median_depth, max_id = self._read_lists(lists) if options.with_ids else (None, None)
        return TensorRendering(
            rgb=images[0, :, :, :3].permute(2, 0, 1),
            depth=images[0, :, :, -1],
            alpha=alphas[0, :, :, 0],
            features=None if gaussians.features is None else images[0, :, :, 3:-1],
            median_depth=median_depth,
            max_id=max_id,
        )

    def contribution_weights(
        self,
        gaussians: GaussianTensors,
        camera: Camera,
        masks: Tensor,
        options: RasterOptions,
        *,
        parts: PartTensors | None = None,
    ) -> Tensor:
        """Compute the same as `rasterizer.contribution_weights`, for masks (M, H, W) on the same device.

        The image of a feature is the sum of the features times their weights. Therefore the gradient of the sum of
        image times mask with respect to the features is the result.
        """
        check_scene(gaussians, camera, 0)
        if parts is not None:
            check_parts(gaussians, parts)
        if masks.ndim != 3 or not len(masks) or masks.shape[1:] != (camera.height, camera.width):
            raise ValueError(
                f"masks have shape {tuple(masks.shape)}, expected (M, {camera.height}, {camera.width})"
            )
        count = len(gaussians.means)
        channels = masks.new_zeros((count, len(masks)))
        if not count:
            return channels
        gaussians = finite_only(replace(gaussians, features=None))
        view = (camera, _viewmat(camera, gaussians), parts)
        with torch.enable_grad():
            channels.requires_grad_()
            images, _, _ = self._rasterize(gaussians, view, options, (channels, None, "RGB"))
            (weights,) = torch.autograd.grad(images, channels, masks.permute(1, 2, 0)[None])
        return weights

    def _rasterize(
        self,
        gaussians: GaussianTensors,
        view: tuple[Camera, Tensor, PartTensors | None],
        options: RasterOptions,
        painting: tuple[Tensor, Tensor | None, str],
    ) -> tuple[Tensor, Tensor, dict]:
        """Render images (1, H, W, D), alphas (1, H, W, 1) and tile lists for given channels, background and mode."""
        (camera, T_cam_world, parts), (channels, background, mode) = view, painting
        means, quats = gaussians.means, gaussians.quats
        if parts is not None:
            means, quats = place_in_world(means, quats, parts)
        return self._gsplat.rasterization(
            means=means,
            quats=quats,
            scales=gaussians.log_scales.exp(),
            opacities=gaussians.logit_opacities.sigmoid(),
            colors=channels,
            viewmats=T_cam_world[None],
            Ks=means.new_tensor(camera.K)[None],
            width=camera.width,
            height=camera.height,
            near_plane=options.near_depth,
            eps2d=_DILATION,
            radius_clip=0.0,
            backgrounds=background,
            render_mode=mode,
            packed=False,  # so that rows of the lists are rows of the Gaussians
            rasterize_mode="antialiased" if options.antialiased else "classic",
        )

    @torch.no_grad()
    def _read_lists(self, lists: dict) -> tuple[Tensor, Tensor]:
        """Compute median depth and largest contribution (H, W) from the list of Gaussians of every pixel."""
        centers, conics, opacities = lists["means2d"], lists["conics"], lists["opacities"]
        height, width = lists["height"], lists["width"]
        gaussians, pixels, _ = self._gsplat.rasterize_to_indices_in_range(
            0,
            2**31 - 1,  # a single range, because a saturated pixel must not continue in another one
            centers.new_ones((1, height, width)),
            centers,
            conics,
            opacities,
            width,
            height,
            lists["tile_size"],
            lists["isect_offsets"],
            lists["flatten_ids"],
        )
        dx = pixels % width + 0.5 - centers[0, gaussians, 0]
        dy = pixels // width + 0.5 - centers[0, gaussians, 1]
        a, b, c = conics[0, gaussians].unbind(-1)
        exponents = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
        alphas = (opacities[0, gaussians] * exponents.exp()).clamp_max(MAX_ALPHA)
        return median_depth_and_max_id(pixels, gaussians, alphas, lists["depths"][0], (height, width))


def _viewmat(camera: Camera, gaussians: GaussianTensors) -> Tensor:
    return gaussians.means.new_tensor(camera.T_cam_world)


def _nothing(
    gaussians: GaussianTensors, camera: Camera, background: Tensor, with_ids: bool
) -> TensorRendering:
    """Return the rendering of zero Gaussians, with empty gradients; gsplat would divide by their number."""
    shape, features = (camera.height, camera.width), gaussians.features
    arrays = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)
    zeros = background.new_zeros(shape) + sum(array.sum() for array in arrays)
    return TensorRendering(
        rgb=background[:, None, None] + zeros,
        depth=zeros,
        alpha=zeros,
        features=None if features is None else zeros[:, :, None].expand(*shape, features.shape[1]),
        median_depth=torch.zeros_like(zeros) if with_ids else None,
        max_id=torch.full_like(zeros, -1, dtype=torch.int32) if with_ids else None,
    )


@torch.no_grad()
def median_depth_and_max_id(
    pixels: Tensor, gaussians: Tensor, alphas: Tensor, depths: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Compute the depth at which the transmittance falls below one half, and the Gaussian of the largest weight.

    Args:
        pixels: (M,) row-major index of the pixel, ascending; within a pixel from near to far.
        gaussians: (M,) index of the Gaussian.
        alphas: (M,) alpha of the Gaussian at the pixel, 0 <= alpha < 1.
        depths: (N,) depths of the Gaussians, [m].
        shape: Height and width of the images.

    Returns:
        Median depth, 0 if the transmittance remains above one half; largest contribution, -1 if there is none.
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
    """Compute the transmittance behind every pair (M,), and the weight of the pair (M,), float64."""
    alphas = alphas.double()
    logs = torch.log1p(-alphas)
    sums = logs.cumsum(0)
    starts = torch.ones_like(pixels, dtype=torch.bool)
    starts[1:] = pixels[1:] != pixels[:-1]
    before = (sums - logs)[starts][starts.cumsum(0) - 1]
    return (sums - before).exp(), alphas * (sums - logs - before).exp()


def _first_of_pixels(pixels: Tensor, chosen: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the pixels that have a chosen pair, and the row of the first chosen pair."""
    rows = torch.arange(len(pixels), device=pixels.device)
    first = rows.new_full((count,), len(rows)).scatter_reduce_(0, pixels[chosen], rows[chosen], "amin")
    which = (first < len(rows)).nonzero()[:, 0]
    return which, first[which]
