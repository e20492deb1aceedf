"""Gaussians of moving parts in the world frame, and where a camera looks at them from, in torch."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from aomgen.splatting.differentiable import PartTensors


def place_in_world(means: Tensor, quats: Tensor, parts: PartTensors) -> tuple[Tensor, Tensor]:
    """Means (N, 3) and quaternions (N, 4) of Gaussians in the world, differentiable by all inputs.

    Args:
        means: (N, 3), in the frame of the Gaussian's part.
        quats: (N, 4) wxyz, in the frame of the Gaussian's part, any length.
        parts: Which part every Gaussian belongs to, and where the parts are.
    """
    rows = parts.indices.long()
    R_world_part, t_world_part = parts.Ts_world_part[:, :3, :3], parts.Ts_world_part[:, :3, 3]
    turned = (R_world_part[rows] * means[:, None, :]).sum(-1)
    return turned + t_world_part[rows], multiply_quats(rotation_quats(R_world_part)[rows], quats)


def view_directions(means: Tensor, T_cam_world: Tensor, parts: PartTensors | None) -> Tensor:
    """Directions (N, 3) from the camera to the Gaussians in the frame their SH are written in, any length.

    The camera's centre is carried into every part's frame, which turns the directions exactly without
    touching the coefficients.

    Args:
        means: (N, 3), in the frame of the Gaussian's part, or the world without parts.
        T_cam_world: (4, 4) rigid.
        parts: None where the Gaussians are in the world frame.
    """
    center_world = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    if parts is None:
        directions = means - center_world
    else:
        R_world_part, t_world_part = parts.Ts_world_part[:, :3, :3], parts.Ts_world_part[:, :3, 3]
        centers_part = ((center_world - t_world_part)[:, :, None] * R_world_part).sum(1)
        directions = means - centers_part[parts.indices.long()]
    # At the camera's centre there is no direction; the Gaussian is not drawn, but must not spoil gradients.
    nowhere = (directions == 0).all(-1, keepdim=True)
    return torch.where(nowhere, torch.ones_like(directions), directions)


def rotation_quats(rotations: Tensor) -> Tensor:
    """Unit quaternions (P, 4) wxyz of rotation matrices (P, 3, 3), differentiable at every rotation.

    Source: Shepperd 1978, doi:10.2514/3.55767b: of the rows of 4 q q^T, which are linear in the
    matrix, the one with the largest diagonal entry.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotations.unbind(-2))
    x, y, z = h - f, c - g, d - b
    xy, xz, yz = b + d, c + g, f + h
    entries = [1 + a + e + i, x, y, z, x, 1 + a - e - i, xy, xz]
    entries += [y, xy, 1 - a + e - i, yz, z, xz, yz, 1 - a - e + i]
    outer = torch.stack(entries, -1).unflatten(-1, (4, 4))
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return normalize(outer[torch.arange(len(outer), device=outer.device), best], dim=-1)


def multiply_quats(first: Tensor, second: Tensor) -> Tensor:
    """Products (N, 4) wxyz of quaternions (N, 4): the rotation `second`, then `first`."""
    (a, b, c, d), (w, x, y, z) = first.unbind(-1), second.unbind(-1)
    products = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(products, -1)
