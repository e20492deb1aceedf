"""Projection of points into calibrated views, and triangulation from several views."""

from typing import NamedTuple

import torch
from torch import Tensor

# Number of iterations of least squares. The distances that determine the weights of the views are estimated in each iteration.
ROUNDS = 3


class Views(NamedTuple):
    """Calibrated cameras of a batch.

    Attributes:
        size: Width and height of all images, [px].
        K: Intrinsic matrices (C, 3, 3), [px].
        T_world_cam: Poses (B, C, 4, 4), [m].
    """

    size: tuple[int, int]
    K: Tensor
    T_world_cam: Tensor


def project_points(views: Views, points_world: Tensor) -> tuple[Tensor, Tensor]:
    """Project points (B, P, 3), world frame, [m], to pixels (B, C, P, 2) and depths (B, C, P), [m]."""
    R, t = views.T_world_cam[..., :3, :3], views.T_world_cam[..., :3, 3]
    points_cam = torch.einsum("bcji,bcpj->bcpi", R, points_world[:, None] - t[:, :, None])
    pixels = torch.einsum("cij,bcpj->bcpi", views.K, points_cam)
    return pixels[..., :2] / pixels[..., 2:], points_cam[..., 2]


def lift_points(views: Views, pixels: Tensor, spreads: Tensor) -> tuple[Tensor, Tensor]:
    """Triangulate points by weighted least squares of their distances to the rays.

    Args:
        views: Two or more cameras at different positions.
        pixels: Estimated pixels (B, C, P, 2).
        spreads: Standard deviations of the pixels (B, C, P), [px]. The weight of a ray is the inverse square of the standard
            deviation in meters at the distance of the point.

    Returns:
        Points (B, P, 3), world frame, [m], and their standard deviations (B, P), [m]: the square root of the sum of the three
        variances that follow from `spreads`.
    """
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
    rays = torch.einsum("cij,bcpj->bcpi", torch.linalg.inv(views.K), homogeneous)
    rays = torch.einsum("bcij,bcpj->bcpi", views.T_world_cam[..., :3, :3], rays)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    across = torch.eye(3, device=rays.device) - rays[..., :, None] * rays[..., None, :]
    centers = views.T_world_cam[:, :, None, :3, 3].expand_as(rays)
    focal = (views.K[:, 0, 0] * views.K[:, 1, 1]).sqrt()[:, None]
    distances = torch.ones_like(spreads)
    for _ in range(ROUNDS):
        weights = (focal / (spreads * distances)) ** 2
        information = (weights[..., None, None] * across).sum(1)
        weighted = torch.einsum("bcp,bcpij,bcpj->bpi", weights, across, centers)
        points = torch.linalg.solve(information, weighted)
        distances = (points[:, None] - centers).norm(dim=-1)
    covariances = torch.linalg.inv(information)
    return points, covariances.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
