"""gsplat's compiled functions in torch, so that the Python code of gsplat runs on a CPU.

Projection, harmonics and tile lists are gsplat's own reference functions (`gsplat.cuda._torch_impl`); the
blending, which gsplat has in CUDA alone, is written here with its rules. As the compiled functions do,
these insist on contiguous tensors and leave what they cull undefined (NaN here).
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

MIN_ALPHA, MAX_ALPHA, MIN_LEFT = 1 / 255, 0.999, 1e-4


def install(gsplat: ModuleType, patch: pytest.MonkeyPatch) -> None:
    """Install the functions of this file in place of gsplat's compiled ones."""
    from gsplat.cuda import _torch_impl, _wrapper

    functions: dict[str, Callable] = {
        "projection_ewa_3dgs_fused_fwd": lambda *a: _project(_torch_impl, *a),
        "projection_ewa_3dgs_fused_bwd": lambda *a: _project_backward(_torch_impl, *a),
        "spherical_harmonics_fwd": lambda *a: _harmonics(_torch_impl, *a),
        "spherical_harmonics_bwd": lambda *a: _harmonics_backward(_torch_impl, *a),
        "intersect_tile": lambda centers, radii, depths, images, ids, count, *a: _torch_impl._isect_tiles(
            centers, radii, depths.nan_to_num(), *a[:3]
        ),
        "intersect_offset": lambda *a: _torch_impl._isect_offset_encode(*a),
        "rasterize_to_pixels_3dgs_fwd": _blend,
        "rasterize_to_pixels_3dgs_bwd": _blend_backward,
        "rasterize_to_indices_3dgs": _indices,
    }
    patch.setattr(_wrapper, "_make_lazy_cuda_func", lambda name: _checked(functions[name]))
    patch.setattr(_wrapper, "_make_lazy_cuda_obj", lambda name: name.rsplit(".")[-1].lower())


def _checked(function: Callable) -> Callable:
    def call(*arguments: Any) -> Any:
        for argument in arguments:
            if isinstance(argument, Tensor):
                assert argument.is_contiguous()
        return function(*arguments)

    return call


def _project(impl: ModuleType, *arguments: Any) -> tuple:
    means, covars, quats, scales, opacities, viewmats, Ks = arguments[:7]
    width, height, dilation, near, far, radius_clip, antialiased, model = arguments[7:]
    assert len(means) > 0  # the compiled function divides by the number of Gaussians
    assert covars is None
    assert radius_clip == 0
    assert model == "pinhole"
    covars, _ = impl._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, centers, depths, conics, areas = impl._fully_fused_projection(
        means, covars, viewmats, Ks, width, height, dilation, near, far, antialiased
    )
    faint = opacities * (areas if antialiased else 1) < MIN_ALPHA
    radii[faint.expand(radii.shape[:-1])] = 0
    culled = (radii <= 0).any(-1)
    for values in (centers, depths, conics):
        values[culled] = torch.nan
    if antialiased:
        areas[culled] = 0
    return radii, centers, depths, conics, areas


def _project_backward(impl: ModuleType, *arguments: Any) -> tuple:
    means, _, quats, scales, viewmats, Ks, width, height, dilation, _, radii = arguments[:11]
    antialiased = arguments[12] is not None
    seen = (radii[0] > 0).all(-1)
    leaves = [tensor.detach()[seen].requires_grad_() for tensor in (means, quats, scales)]
    view = viewmats.detach().clone().requires_grad_()
    with torch.enable_grad():
        covars, _ = impl._quat_scale_to_covar_preci(leaves[1], leaves[2], True, False)
        _, centers, depths, conics, areas = impl._fully_fused_projection(
            leaves[0], covars, view, Ks, width, height, dilation, calc_compensations=antialiased
        )
        drawn = [centers, depths, conics] + ([areas] if antialiased else [])
        by_drawn = [gradient[:, seen] for gradient in arguments[13:17] if gradient is not None]
        found = torch.autograd.grad(drawn, [*leaves, view], by_drawn)
    dense = [torch.zeros_like(tensor) for tensor in (means, quats, scales)]
    for tensor, gradient in zip(dense, found, strict=False):
        tensor[seen] = gradient
    return dense[0], None, dense[1], dense[2], found[3]


def _harmonics(impl: ModuleType, degree: int, dirs: Tensor, sh: Tensor, masks: None) -> Tensor:
    assert bool((dirs != 0).any(-1).all())  # the compiled function divides by the length
    return impl._spherical_harmonics(degree, dirs, sh)


def _harmonics_backward(impl: ModuleType, *arguments: Any) -> tuple:
    _, degree, dirs, sh, _, by_colors, _ = arguments
    dirs, sh = dirs.detach().requires_grad_(), sh.detach().requires_grad_()
    with torch.enable_grad():
        colors = impl._spherical_harmonics(degree, dirs, sh)
        by_dirs, by_sh = torch.autograd.grad(colors, [dirs, sh], by_colors, allow_unused=True)
    return by_sh, torch.zeros_like(dirs) if by_dirs is None else by_dirs


def _tiles(width: int, height: int, size: int, offsets: Tensor, ids: Tensor) -> Any:
    """Yield for every tile the pixel rows, the pixel columns and the list of Gaussians."""
    ends = torch.cat([offsets.flatten()[1:], torch.tensor([len(ids)])])
    for tile, (first, end) in enumerate(zip(offsets.flatten().tolist(), ends.tolist(), strict=True)):
        top, left = tile // offsets.shape[-1] * size, tile % offsets.shape[-1] * size
        rows, columns = range(top, min(top + size, height)), range(left, min(left + size, width))
        yield rows, columns, ids[first:end].long()


def _tile_alphas(
    rows: range, columns: range, ids: Tensor, centers: Tensor, conics: Tensor, opacities: Tensor
) -> Tensor:
    """Compute alphas (n, rows, columns), zero where a Gaussian is skipped or follows the stop."""
    offset_y = centers[0, ids, 1, None] - torch.tensor([row + 0.5 for row in rows])
    offset_x = centers[0, ids, 0, None] - torch.tensor([column + 0.5 for column in columns])
    dx, dy = offset_x[:, None, :], offset_y[:, :, None]
    a, b, c = (conics[0, ids, k, None, None] for k in range(3))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alphas = (opacities[0, ids, None, None] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    alphas = torch.where((sigma >= 0) & (alphas >= MIN_ALPHA), alphas, 0.0)
    with torch.no_grad():
        drawn = (1 - alphas).cumprod(0) > MIN_LEFT
    return alphas * drawn


def _blend(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    centers, conics, colors, opacities, backgrounds, masks, width, height, size, offsets, ids = arguments
    assert masks is None
    image = torch.zeros(1, height, width, colors.shape[-1])
    alpha = torch.zeros(1, height, width, 1)
    for rows, columns, listed in _tiles(width, height, size, offsets, ids):
        block = (0, slice(rows.start, rows.stop), slice(columns.start, columns.stop))
        alphas = _tile_alphas(rows, columns, listed, centers, conics, opacities)
        left = torch.cat([torch.ones(1, *alphas.shape[1:]), (1 - alphas).cumprod(0)])
        image[block] = torch.einsum("nhw,nc->hwc", alphas * left[:-1], colors[0, listed])
        alpha[block] = 1 - left[-1, :, :, None]
    if backgrounds is not None:
        image = image + (1 - alpha) * backgrounds[:, None, None]
    return image, alpha, torch.zeros(1, height, width, dtype=torch.int32)


def _blend_backward(*arguments: Any) -> tuple:
    leaves = [tensor.detach().clone().requires_grad_() for tensor in arguments[:4]]
    by_image, by_alpha, absolute = arguments[13:]
    assert not absolute
    with torch.enable_grad():
        image, alpha, _ = _blend(*leaves, *arguments[4:11])
        found = torch.autograd.grad([image, alpha], leaves, [by_image, by_alpha])
    return None, *found


def _indices(*arguments: Any) -> tuple[Tensor, Tensor]:
    start, end, left, centers, conics, opacities, width, height, size, offsets, ids = arguments
    assert start == 0
    assert end * size * size >= len(ids)
    assert bool((left == 1).all())
    gaussians, pixels = [], []
    for rows, columns, listed in _tiles(width, height, size, offsets, ids):
        alphas = _tile_alphas(rows, columns, listed, centers, conics, opacities)
        row, column, which = (alphas > 0).permute(1, 2, 0).nonzero().unbind(-1)
        gaussians.append(listed[which])
        pixels.append((rows.start + row) * width + columns.start + column)
    order = torch.cat(pixels).argsort(stable=True)
    return torch.cat(gaussians)[order], torch.cat(pixels)[order]
