"""Reference of every rasterizer of tensors: float64 torch, all Gaussians on all pixels at once."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from aomgen.core.camera import Camera
from aomgen.splatting.differentiable import GaussianTensors, PartTensors, RasterOptions, TensorRendering
from splatting_reference import rotation_matrices, sh_basis

DILATION, MIN_ALPHA, MIN_LEFT = 0.1, 1 / 255, 1e-4


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Differences between the engine and gsplat: largest alpha of a Gaussian, and whether the Gaussian that reduces the
    transmittance below 1e-4 is still drawn.
    """

    max_alpha: float
    draws_last: bool


ENGINE, GSPLAT = Rules(max_alpha=0.99, draws_last=True), Rules(max_alpha=0.999, draws_last=False)


def in_world(gaussians: GaussianTensors, parts: PartTensors | None) -> tuple[Tensor, Tensor]:
    """Compute means (N, 3), and axes times standard deviations (N, 3, 3), in the world frame."""
    axes = rotation_matrices(gaussians.quats) * gaussians.log_scales.exp()[:, None]
    if parts is None:
        return gaussians.means, axes
    Ts = parts.Ts_world_part[parts.indices.long()]
    return torch.einsum("nij,nj->ni", Ts[:, :3, :3], gaussians.means) + Ts[:, :3, 3], Ts[:, :3, :3] @ axes


def colors(gaussians: GaussianTensors, T_cam_world: Tensor, parts: PartTensors | None, degree: int) -> Tensor:
    """Compute colors (N, 3) from the direction in the part's frame."""
    Ts_cam_part = T_cam_world[None]
    if parts is not None:
        Ts_cam_part = (T_cam_world @ parts.Ts_world_part)[parts.indices.long()]
    centers = -torch.einsum("nji,nj->ni", Ts_cam_part[:, :3, :3], Ts_cam_part[:, :3, 3])
    basis = sh_basis(normalize(gaussians.means - centers, dim=-1), degree)
    return (0.5 + torch.einsum("nk,nkc->nc", basis, gaussians.sh[:, : basis.shape[1]])).clamp_min(0)


def splats(
    gaussians: GaussianTensors, camera: Camera, T_cam_world: Tensor, parts: PartTensors | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute centers (N, 2), precisions (N, 2, 2), opacity factors of the antialiasing (N,), and depths (N,)."""
    means, axes = in_world(gaussians, parts)
    R = T_cam_world[:3, :3]
    x, y, z = (means @ R.T + T_cam_world[:3, 3]).unbind(-1)
    edge_x, edge_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    sx = (x / z).clamp(-camera.cx / camera.fx - edge_x, (camera.width - camera.cx) / camera.fx + edge_x)
    sy = (y / z).clamp(-camera.cy / camera.fy - edge_y, (camera.height - camera.cy) / camera.fy + edge_y)
    zero = torch.zeros_like(z)
    rows = [[camera.fx / z, zero, -camera.fx * sx / z], [zero, camera.fy / z, -camera.fy * sy / z]]
    A = torch.stack([torch.stack(row, -1) for row in rows], -2) @ R @ axes
    sharp = A @ A.transpose(1, 2)
    blurred = sharp + DILATION * torch.eye(2, dtype=z.dtype)
    share = (torch.linalg.det(sharp) / torch.linalg.det(blurred)).clamp_min(0).sqrt()
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return centers, torch.linalg.inv(blurred), share, z


@dataclass(frozen=True, kw_only=True)
class Blend:
    """Weights (N, H, W) in the order of the Gaussians, the transmittance behind each, depths (N,), and the pixels (H, W) at
    which no alpha and no transmittance is so close to a limit that float32 may decide otherwise.
    """

    weights: Tensor
    left: Tensor
    depths: Tensor
    clear: Tensor


def blend(
    gaussians: GaussianTensors,
    camera: Camera,
    options: RasterOptions,
    T_cam_world: Tensor,
    parts: PartTensors | None,
    rules: Rules,
) -> Blend:
    """Compute the weight of every Gaussian in every pixel."""
    centers, precisions, share, depths = splats(gaussians, camera, T_cam_world, parts)
    rows = torch.arange(camera.height, dtype=depths.dtype) + 0.5
    columns = torch.arange(camera.width, dtype=depths.dtype) + 0.5
    dy, dx = (rows - centers[:, 1:])[:, :, None], (columns - centers[:, :1])[:, None, :]
    a, b, c = (precisions[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    opacities = gaussians.logit_opacities.sigmoid() * (share if options.antialiased else 1)
    alphas = opacities[:, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    order = depths.argsort(stable=True)
    alphas, near = alphas[order], (depths > options.near_depth)[order, None, None]
    clear = ~(near & ((alphas / MIN_ALPHA - 1).abs() < 1e-4)).any(0)
    alphas = torch.where(near & (alphas >= MIN_ALPHA), alphas.clamp_max(rules.max_alpha), 0.0)
    before = torch.cat([torch.ones_like(alphas[:1]), (1 - alphas).cumprod(0)[:-1]])
    enough = before if rules.draws_last else before * (1 - alphas)
    clear &= ~((enough / MIN_LEFT - 1).abs() < 1e-3).any(0)
    alphas = alphas * (enough > MIN_LEFT)
    left = (1 - alphas).cumprod(0)
    before = torch.cat([torch.ones_like(left[:1]), left[:-1]])
    back = order.argsort()
    return Blend(weights=(alphas * before)[back], left=left[back], depths=depths, clear=clear)


def render(
    gaussians: GaussianTensors,
    camera: Camera,
    options: RasterOptions,
    T_cam_world: Tensor,
    parts: PartTensors | None,
    rules: Rules,
) -> tuple[TensorRendering, Blend]:
    """Render all outputs of a rasterizer, differentiable except for median depth and largest contribution."""
    b = blend(gaussians, camera, options, T_cam_world, parts, rules)
    alpha, features = b.weights.sum(0), gaussians.features
    shades = colors(gaussians, T_cam_world, parts, options.sh_degree)
    background = torch.tensor(options.background, dtype=alpha.dtype)
    past_half = (b.left < 0.5) & (b.weights > 0)
    far = torch.where(past_half, b.depths[:, None, None], torch.inf).amin(0)
    largest, max_id = b.weights.max(0)
    drawn = TensorRendering(
        rgb=torch.einsum("nhw,nc->chw", b.weights, shades) + (1 - alpha) * background[:, None, None],
        depth=torch.einsum("nhw,n->hw", b.weights, b.depths),
        alpha=alpha,
        features=None if features is None else torch.einsum("nhw,nd->hwd", b.weights, features),
        median_depth=torch.where(far.isfinite(), far, 0.0),
        max_id=torch.where(largest > 0, max_id, -1).int(),
    )
    return drawn, b


def twists(T: Tensor, by_T: Tensor) -> Tensor:
    """Compute the gradient (..., 6) by small motions of a transform (..., 4, 4) in its target frame.

    Entries of a matrix cannot move freely; rigid motions are what gradients of rigid transforms mean.
    """
    generators = torch.zeros(6, 4, 4, dtype=T.dtype)
    for axis in range(3):
        generators[axis, axis, 3] = 1
        first, second = (axis + 1) % 3, (axis + 2) % 3
        generators[3 + axis, second, first], generators[3 + axis, first, second] = 1, -1
    return torch.einsum("...ij,kil,...lj->...k", by_T, generators, T)
