"""Rendering of 3D Gaussians on a CPU, with gradients, and training; usable without the rest of AOMGen.

>>> from aomgen.splatting import framing_camera, read_gaussians, render
>>> gaussians = read_gaussians(Path("scene.ply"))
>>> image = render(gaussians, framing_camera(gaussians, (640, 480))).rgb

Names are imported when they are first used: rendering needs only numpy; differentiable rasterizers and training need
torch. `docs/splatting.md` documents conventions and file formats.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aomgen.core.camera import Camera as Camera
    from aomgen.core.camera import look_at as look_at
    from aomgen.core.gaussians import Gaussians as Gaussians
    from aomgen.core.gaussians import gaussians_from_points as gaussians_from_points
    from aomgen.io.colmap import read_colmap as read_colmap
    from aomgen.io.gaussian_files import read_gaussians as read_gaussians
    from aomgen.io.gaussian_files import write_gaussians as write_gaussians
    from aomgen.splatting.compute import make_rasterizer as make_rasterizer
    from aomgen.splatting.differentiable import CpuRasterizer as CpuRasterizer
    from aomgen.splatting.differentiable import GaussianTensors as GaussianTensors
    from aomgen.splatting.differentiable import PartTensors as PartTensors
    from aomgen.splatting.differentiable import RasterOptions as RasterOptions
    from aomgen.splatting.differentiable import TensorRendering as TensorRendering
    from aomgen.splatting.framing import framing_camera as framing_camera
    from aomgen.splatting.metrics import psnr as psnr
    from aomgen.splatting.metrics import ssim as ssim
    from aomgen.splatting.rasterizer import Rendering as Rendering
    from aomgen.splatting.rasterizer import RigidParts as RigidParts
    from aomgen.splatting.rasterizer import contribution_weights as contribution_weights
    from aomgen.splatting.rasterizer import render as render
    from aomgen.splatting.session import Motion as Motion
    from aomgen.splatting.session import RenderSession as RenderSession
    from aomgen.splatting.training import TrainingParams as TrainingParams
    from aomgen.splatting.training import train as train

_HOMES = {
    "Camera": "aomgen.core.camera",
    "look_at": "aomgen.core.camera",
    "Gaussians": "aomgen.core.gaussians",
    "read_colmap": "aomgen.io.colmap",
    "read_gaussians": "aomgen.io.gaussian_files",
    "write_gaussians": "aomgen.io.gaussian_files",
    "CpuRasterizer": "aomgen.splatting.differentiable",
    "GaussianTensors": "aomgen.splatting.differentiable",
    "PartTensors": "aomgen.splatting.differentiable",
    "RasterOptions": "aomgen.splatting.differentiable",
    "TensorRendering": "aomgen.splatting.differentiable",
    "framing_camera": "aomgen.splatting.framing",
    "gaussians_from_points": "aomgen.core.gaussians",
    "psnr": "aomgen.splatting.metrics",
    "ssim": "aomgen.splatting.metrics",
    "RigidParts": "aomgen.splatting.rasterizer",
    "Rendering": "aomgen.splatting.rasterizer",
    "contribution_weights": "aomgen.splatting.rasterizer",
    "render": "aomgen.splatting.rasterizer",
    "make_rasterizer": "aomgen.splatting.compute",
    "Motion": "aomgen.splatting.session",
    "RenderSession": "aomgen.splatting.session",
    "TrainingParams": "aomgen.splatting.training",
    "train": "aomgen.splatting.training",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_HOMES)}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
