"""Checks and conversions of Gaussians and cameras for gsplat; an invalid index on a GPU would terminate the process."""

import importlib
from dataclasses import replace
from types import ModuleType

import torch
from torch import Tensor
from torch.nn.functional import normalize

from aomgen.core.camera import Camera
from aomgen.errors import BackendError
from aomgen.splatting.differentiable import GaussianTensors, PartTensors, check_tensors

FIRST_VERSION, END_VERSION = (1, 5, 3), (2,)
_EXTRA = "pip install 'aomgen[gpu]'"


def check_scene(gaussians: GaussianTensors, camera: Camera, sh_degree: int) -> None:
    """Check the tensors of Gaussians (see `check_tensors`), the size of the image and the SH degree.

    Raises:
        BackendError: The image has no pixels, or the coefficients do not reach the SH degree.
        TypeError, ValueError: See `check_tensors`.
    """
    if camera.width < 1 or camera.height < 1:
        raise BackendError(
            "gsplat", f"an image of {camera.width} x {camera.height} pixels", "check the camera"
        )
    check_tensors(gaussians, gaussians.means.device)
    if not 0 <= sh_degree <= 3 or (sh_degree + 1) ** 2 > gaussians.sh.shape[1]:
        problem = f"SH degree {sh_degree} of {gaussians.sh.shape[1]} coefficients"
        raise BackendError("gsplat", problem, "choose a degree of 0 to 3 that the Gaussians have")


def check_parts(gaussians: GaussianTensors, parts: PartTensors) -> None:
    """Check that parts have valid shapes and that each Gaussian's index refers to one of them.

    Raises:
        BackendError: An index is out of range.
        ValueError: A shape is invalid.
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
    """Make Gaussians with NaN or infinite values invisible, without gradients; other Gaussians do not change."""
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


def load_gsplat() -> ModuleType:
    """Import gsplat with its kernels; their compilation at the first call on a machine takes minutes.

    Raises:
        BackendError: There is no CUDA device, gsplat is missing or of an unsupported version, or its kernels do not build.
    """
    if not torch.cuda.is_available():
        build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "the CPU"
        remedy = "use a machine with an NVIDIA GPU and a CUDA build of torch, or device 'cpu'"
        raise BackendError(
            "gsplat", f"no CUDA device is found by torch {torch.__version__} for {build}", remedy
        )
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        raise BackendError("gsplat", f"it cannot be imported ({error})", _EXTRA) from error
    check_version(str(gsplat.__version__))
    try:
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except (ImportError, OSError, RuntimeError) as error:
        remedy = f"install the CUDA toolkit {torch.version.cuda} and a C++ compiler that it supports"
        raise BackendError("gsplat", f"its kernels do not build ({error})", remedy) from error
    if kernels is None:
        remedy = (
            f"install the CUDA toolkit {torch.version.cuda}, or a wheel of gsplat with kernels for this torch"
        )
        raise BackendError("gsplat", "it has no kernels, and no nvcc is found to build them", remedy)
    return gsplat


def check_version(version: str) -> None:
    """Check that a version of gsplat is supported.

    Raises:
        BackendError: The version is outside the supported range.
    """
    numbers = tuple(int(part) for part in version.split("+")[0].split(".") if part.isdigit())
    if not FIRST_VERSION <= numbers < END_VERSION:
        first, end = (".".join(map(str, limit)) for limit in (FIRST_VERSION, END_VERSION))
        raise BackendError("gsplat", f"version {version}, expected {first} or later and before {end}", _EXTRA)


def place_in_world(means: Tensor, quats: Tensor, parts: PartTensors) -> tuple[Tensor, Tensor]:
    """Transform means (N, 3) and quaternions (N, 4) wxyz from the frames of their parts to the world frame.

    The result is differentiable with respect to all inputs; quaternions are not normalized.
    """
    rows = parts.indices.long()
    R_world_part, t_world_part = parts.Ts_world_part[:, :3, :3], parts.Ts_world_part[:, :3, 3]
    turned = (R_world_part[rows] * means[:, None, :]).sum(-1)
    return turned + t_world_part[rows], multiply_quats(rotation_quats(R_world_part)[rows], quats)


def view_directions(means: Tensor, T_cam_world: Tensor, parts: PartTensors | None) -> Tensor:
    """Compute directions (N, 3) from the camera to the Gaussians, in the frames of their SH coefficients; not normalized.

    The camera center is transformed to the frame of each part, which is exact and requires no rotation of the coefficients.
    """
    center_world = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
    if parts is None:
        directions = means - center_world
    else:
        R_world_part, t_world_part = parts.Ts_world_part[:, :3, :3], parts.Ts_world_part[:, :3, 3]
        centers_part = ((center_world - t_world_part)[:, :, None] * R_world_part).sum(1)
        directions = means - centers_part[parts.indices.long()]
    # A Gaussian at the camera center has no direction. It is not rendered, but a zero direction would give NaN gradients.
    nowhere = (directions == 0).all(-1, keepdim=True)
    return torch.where(nowhere, torch.ones_like(directions), directions)


def rotation_quats(rotations: Tensor) -> Tensor:
    """Convert rotation matrices (P, 3, 3) to unit quaternions (P, 4) wxyz; differentiable at every rotation.

    The entries of 4 q q^T are linear in the matrix; its row with the largest diagonal entry is normalized.

    Source: Shepperd 1978, doi:10.2514/3.55767b.
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
    """Multiply quaternions (N, 4) wxyz; the product (N, 4) rotates by `second`, then by `first`."""
    (a, b, c, d), (w, x, y, z) = first.unbind(-1), second.unbind(-1)
    products = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(products, -1)
