"""Which rasterizer draws on which device."""

from aomgen.errors import BackendError
from aomgen.splatting.differentiable import CpuRasterizer, Rasterizer
from aomgen.splatting.gsplat_backend import GsplatRasterizer


def make_rasterizer(device: str) -> Rasterizer:
    """The engine for tensors on "cpu", gsplat for tensors on "cuda".

    Raises:
        BackendError: Another device, or what the device needs is missing.
    """
    if device == "cpu":
        return CpuRasterizer()
    if device == "cuda":
        return GsplatRasterizer()
    raise BackendError("rasterizer", f"device '{device}' is unknown", "choose one of: cpu, cuda")
