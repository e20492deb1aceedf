"""The rasterizer by definition: float64 torch, every Gaussian on every pixel, gradients by autograd."""

import numpy as np
import torch
from torch import Tensor

from aomgen.core.camera import Camera

NEAR_DEPTH = 0.01
DILATION = 0.1
MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE = 1 / 255, 0.99, 1e-4


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Compute the basis (N, (degree + 1)^2) at unit directions (N, 3), 3DGS signs and order."""
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        terms += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
        terms += [a * x * y, -a * y * z, b * (2 * z**2 - x**2 - y**2), -a * x * z, c * (x**2 - y**2)]
    if degree >= 3:
        a, b, c = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
        d, e = 0.3731763325901154, 1.445305721320277
        terms += [
            -a * y * (3 * x**2 - y**2),
            b * x * y * z,
            -c * y * (4 * z**2 - x**2 - y**2),
            d * z * (2 * z**2 - 3 * x**2 - 3 * y**2),
            -c * x * (4 * z**2 - x**2 - y**2),
            e * z * (x**2 - y**2),
            -a * x * (x**2 - 3 * y**2),
        ]
    return torch.stack(terms, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Convert quaternions (N, 4) wxyz to rotations (N, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def splats(
    parameters: dict[str, Tensor],
    camera: Camera,
    degree: int,
    Ts_cam_part: Tensor | None = None,
    antialiased: bool = False,
) -> dict[str, Tensor]:
    """Project centers, covariances, colors, opacities and depths to the image; each Gaussian has a pose (4, 4)."""
    if Ts_cam_part is None:
        Ts_cam_part = torch.tensor(camera.T_cam_world).expand(len(parameters["means"]), 4, 4)
    R, t = Ts_cam_part[:, :3, :3], Ts_cam_part[:, :3, 3]
    cam = torch.einsum("nij,nj->ni", R, parameters["means"]) + t
    x, y, z = cam.unbind(-1)
    M = rotation_matrices(parameters["quats"]) * parameters["log_scales"].exp()[:, None]
    limit = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    sx = (x / z).clamp(-camera.cx / camera.fx - limit[0], (camera.width - camera.cx) / camera.fx + limit[0])
    sy = (y / z).clamp(-camera.cy / camera.fy - limit[1], (camera.height - camera.cy) / camera.fy + limit[1])
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * sx / z], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * sy / z], -1),
        ],
        -2,
    )
    A = J @ R @ M
    sharp = A @ A.transpose(1, 2)
    covariance = sharp + DILATION * torch.eye(2, dtype=torch.float64)
    center = -torch.einsum("nji,nj->ni", R, t)
    directions = torch.nn.functional.normalize(parameters["means"] - center, dim=-1)
    basis = sh_basis(directions, degree)
    color = 0.5 + torch.einsum("nk,nkc->nc", basis, parameters["sh"][:, : basis.shape[1]])
    opacity = parameters["logit_opacities"].sigmoid()
    if antialiased:
        opacity = opacity * (torch.linalg.det(sharp) / torch.linalg.det(covariance)).clamp_min(0).sqrt()
    return {
        "center": torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1),
        "precision": torch.linalg.inv(covariance),
        "color": color.clamp_min(0),
        "opacity": opacity,
        "depth": z,
    }


def blend_weights(
    parameters: dict[str, Tensor],
    camera: Camera,
    degree: int,
    Ts_cam_part: Tensor | None = None,
    antialiased: bool = False,
) -> tuple[list[int], Tensor, Tensor, dict]:
    """Compute the indices from near to far, their weights (n, H, W), the remaining transmittance (H, W), and the splats."""
    s = splats(parameters, camera, degree, Ts_cam_part, antialiased)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = torch.tensor(np.stack([columns, rows], -1))
    left = torch.ones(camera.height, camera.width, dtype=torch.float64)
    order = [i for i in torch.argsort(s["depth"], stable=True).tolist() if s["depth"][i] > NEAR_DEPTH]
    weights = []
    for i in order:
        offset = pixels - s["center"][i]
        exponent = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, s["precision"][i], offset)
        alpha = s["opacity"][i] * exponent.exp()
        drawn = (alpha >= MIN_ALPHA) & (left > MIN_TRANSMITTANCE)
        alpha = alpha.clamp_max(MAX_ALPHA) * drawn
        weights.append(alpha * left)
        left = left * (1 - alpha)
    return order, torch.stack(weights), left, s


def render(
    parameters: dict[str, Tensor],
    camera: Camera,
    degree: int,
    background: tuple[float, float, float],
    Ts_cam_part: Tensor | None = None,
    antialiased: bool = False,
) -> tuple[Tensor, ...]:
    """Render rgb (3, H, W), depth (H, W) not divided by alpha, alpha (H, W), and features (H, W, D) if there are any."""
    order, weights, left, s = blend_weights(parameters, camera, degree, Ts_cam_part, antialiased)
    rgb = torch.einsum("nhw,nc->chw", weights, s["color"][order])
    rgb = rgb + left * torch.tensor(background, dtype=torch.float64)[:, None, None]
    images = rgb, torch.einsum("nhw,n->hw", weights, s["depth"][order]), 1 - left
    if "features" in parameters:
        images += (torch.einsum("nhw,nd->hwd", weights, parameters["features"][order]),)
    return images


def image_loss(rendered: Tensor, target: Tensor, gains: Tensor, dssim_weight: float) -> Tensor:
    """Compute L1 and D-SSIM by plain convolution."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2

    def blur(image: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(image[:, None], window[None, None], padding=5)[:, 0]

    x, y = rendered * gains[:, None, None], target
    u, v = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - u * u, blur(y * y) - v * v, blur(x * y) - u * v
    ssim = (2 * u * v + 1e-4) * (2 * cov + 9e-4) / ((u * u + v * v + 1e-4) * (var_x + var_y + 9e-4))
    return (1 - dssim_weight) * (x - y).abs().mean() + dssim_weight * (1 - ssim.mean())
