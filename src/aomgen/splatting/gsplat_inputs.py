"""What is asked of Gaussians and cameras before a GPU sees them: there, a wrong index ends the process."""

from dataclasses import replace

import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.errors import BackendError
from aomgen.splatting.differentiable import GaussianTensors, PartTensors


def check_scene(gaussians: GaussianTensors, camera: Camera, sh_degree: int) -> None:
    """Refuse tensors that do not fit each other or the camera.

    Raises:
        BackendError: An image without pixels, or more SH degrees than coefficients.
        TypeError: Not float32, or on several devices.
        ValueError: Shapes that do not belong together.
    """
    if camera.width < 1 or camera.height < 1:
        raise BackendError(
            "gsplat", f"an image of {camera.width} x {camera.height} pixels", "check the camera"
        )
    count, device = len(gaussians.means), gaussians.means.device
    features = gaussians.features
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "logit_opacities": (count,),
        "sh": (count, gaussians.sh.shape[1] if gaussians.sh.ndim == 3 else 1, 3),
        "features": None if features is None else (count, features.shape[-1]),
    }
    for name, shape in shapes.items():
        tensor: Tensor | None = getattr(gaussians, name)
        if tensor is None:
            continue
        if tensor.dtype != torch.float32 or tensor.device != device:
            raise TypeError(f"{name}: want float32 on {device}, got {tensor.dtype} on {tensor.device}")
        if tensor.shape != shape:
            raise ValueError(f"{name} have shape {tuple(tensor.shape)}, want {shape}")
    if not 0 <= sh_degree <= 3 or (sh_degree + 1) ** 2 > gaussians.sh.shape[1]:
        problem = f"SH degree {sh_degree} of {gaussians.sh.shape[1]} coefficients"
        raise BackendError("gsplat", problem, "choose a degree of 0 to 3 that the Gaussians have")


def check_parts(gaussians: GaussianTensors, parts: PartTensors) -> None:
    """Refuse parts that some Gaussian's index does not name.

    Raises:
        BackendError: An index below zero or past the transforms.
        ValueError: Shapes that do not belong together.
    """
    count, shape = len(gaussians.means), tuple(parts.Ts_world_part.shape)
    if parts.indices.shape != (count,) or shape[1:] != (4, 4):
        raise ValueError(f"parts {tuple(parts.indices.shape)} and transforms {shape} of {count} Gaussians")
    if count:
        first, last = (int(index) for index in parts.indices.aminmax())
        if not (first >= 0 and last < shape[0]):
            problem = f"part indices {first} to {last} of {shape[0]} transforms"
            raise BackendError("gsplat", problem, "give one transform for every part")


def finite_only(gaussians: GaussianTensors) -> GaussianTensors:
    """The same tensors, with Gaussians of NaN or infinite values invisible and without gradient."""
    with torch.no_grad():
        good = gaussians.logit_opacities.isnan().logical_not_() & (gaussians.quats != 0).any(-1)
        for values in (gaussians.means, gaussians.quats, gaussians.log_scales.exp(), gaussians.sh.flatten(1)):
            good &= values.isfinite().all(-1)
        if bool(good.all()):
            return gaussians
    row = good[:, None]
    return replace(
        gaussians,
        means=gaussians.means.where(row, 0.0),
        quats=gaussians.quats.where(row, 1.0),
        log_scales=gaussians.log_scales.where(row, 0.0),
        logit_opacities=gaussians.logit_opacities.where(good, -torch.inf),
        sh=gaussians.sh.where(row[:, None], 0.0),
    )
