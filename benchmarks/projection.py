"""Projection of Gaussians to ellipses on the image in torch, any float type, differentiable by autograd."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians

NEAR_DEPTH = 0.01
DILATION_PX2 = 0.1
MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE = 1 / 255, 0.99, 1e-4
# Centres that are further outside the image than this share of its size get the Jacobian of that limit.
OUTSIDE_SHARE = 0.15
PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@dataclass(frozen=True, slots=True, kw_only=True)
class Splats:
    """N Gaussians on the image.

    Attributes:
        centers: (N, 2), [px].
        precisions: Inverse covariances (N, 3): xx, xy, yy, [1/px^2].
        opacities: (N,), 0..1.
        values: (N, 4): red, green, blue, depth [m].
        half_sizes: (N, 2), [px], of the box outside which alpha stays below 1/255. No gradient.
    """

    centers: Tensor
    precisions: Tensor
    opacities: Tensor
    values: Tensor
    half_sizes: Tensor

    def differentiable(self) -> list[Tensor]:
        """Return centres, precisions, opacities, values."""
        return [self.centers, self.precisions, self.opacities, self.values]


def parameters_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """Convert Gaussians to the optimizer's float32 tensors (logs, logits), by the names in `PARAMETERS`."""
    opacities = gaussians.opacities.astype(np.float64).clip(1e-7, 1 - 1e-7)
    arrays = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "log_scales": np.log(gaussians.scales),
        "logit_opacities": np.log(opacities / (1 - opacities)).astype(np.float32),
        "sh": gaussians.sh,
    }
    return {name: torch.tensor(array) for name, array in arrays.items()}


def project(parameters: dict[str, Tensor], camera: Camera, degree: int) -> Splats:
    """Project all Gaussians to splats, including those behind the camera.

    Args:
        parameters: Tensors by the names in `PARAMETERS`, one float type.
        camera: View in the frame of the means.
        degree: Spherical harmonics that are evaluated, 0..3.

    Source: Kerbl et al. 2023, sec. 4; limits as in gsplat. Not checked: depths
    near zero, where values overflow; the caller drops splats nearer than `NEAR_DEPTH`.
    """
    means = parameters["means"]
    T_cam_world = torch.tensor(camera.T_cam_world, dtype=means.dtype)
    R = T_cam_world[:3, :3]
    x, y, z = (means @ R.T + T_cam_world[:3, 3]).unbind(1)
    u = _limited(x / z, camera.width, camera.cx, camera.fx)
    v = _limited(y / z, camera.height, camera.cy, camera.fy)
    zero = torch.zeros_like(z)
    J = torch.stack([camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], 1)
    axes = _rotations(parameters["quats"]) * parameters["log_scales"].exp()[:, None]
    A = J.reshape(-1, 2, 3) @ R @ axes
    xx, yy = (A.square().sum(2) + DILATION_PX2).unbind(1)
    xy = (A[:, 0] * A[:, 1]).sum(1)
    opacities = parameters["logit_opacities"].sigmoid()
    reach2 = 2 * (opacities.detach() / MIN_ALPHA).clamp_min(1).log()
    center = torch.tensor(camera.center, dtype=means.dtype)
    basis = sh_basis(torch.nn.functional.normalize(means - center, dim=1), degree)
    colors = 0.5 + torch.einsum("nk,nkc->nc", basis, parameters["sh"][:, : basis.shape[1]])
    return Splats(
        centers=torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1),
        precisions=torch.stack([yy, -xy, xx], 1) / (xx * yy - xy * xy)[:, None],
        opacities=opacities,
        values=torch.cat([colors.clamp_min(0), z[:, None]], 1),
        half_sizes=(reach2[:, None] * torch.stack([xx, yy], 1).detach()).sqrt(),
    )


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Compute spherical harmonics (N, (degree + 1)^2) at unit directions (N, 3), signs of the 3DGS files.

    They are built by the recurrences of the associated Legendre polynomials times (x + iy)^m, so that they
    share no code with the expanded polynomials of the engine.
    """
    x, y, z = directions.unbind(1)
    cosines, sines = [torch.ones_like(x)], [torch.zeros_like(x)]  # parts of (x + iy)^m
    for _ in range(degree):
        real, imaginary = cosines[-1], sines[-1]
        cosines.append(x * real - y * imaginary)
        sines.append(x * imaginary + y * real)
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(x, float(np.prod(np.arange(1, 2 * m, 2))) * (-1) ** m)
        if m < degree:
            legendre[m + 1, m] = (2 * m + 1) * z * legendre[m, m]
        for band in range(m + 2, degree + 1):
            higher, lower = legendre[band - 1, m], legendre[band - 2, m]
            legendre[band, m] = ((2 * band - 1) * z * higher - (band + m - 1) * lower) / (band - m)
    terms = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            span = np.prod(np.arange(band - abs(m) + 1, band + abs(m) + 1, dtype=np.float64))
            scale = float(np.sqrt((2 * band + 1) / (4 * np.pi * span) * (1 if m == 0 else 2)))
            terms.append(scale * legendre[band, abs(m)] * (sines if m < 0 else cosines)[abs(m)])
    return torch.stack(terms, 1)


def _limited(ratio: Tensor, size: int, center: float, focal: float) -> Tensor:
    margin = OUTSIDE_SHARE * size
    return ratio.clamp((-center - margin) / focal, (size - center + margin) / focal)


def _rotations(quats: Tensor) -> Tensor:
    """Convert quaternions (N, 4) wxyz, normalised here, to (N, 3, 3): (w^2 - v.v) I + 2 v v^T + 2 w [v]x."""
    q = torch.nn.functional.normalize(quats, dim=1)
    w, v = q[:, :1, None], q[:, 1:]
    unit = torch.eye(3, dtype=q.dtype)
    cross = torch.linalg.cross(v[:, :, None].expand(-1, 3, 3), unit[None], dim=1)
    outer = v[:, :, None] * v[:, None]
    return (w * w - v.square().sum(1)[:, None, None]) * unit + 2 * outer + 2 * w * cross
