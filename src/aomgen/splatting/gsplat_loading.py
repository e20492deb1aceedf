"""The installed gsplat, or a sentence that says what is missing."""

import importlib
from types import ModuleType

import torch

from aomgen.errors import BackendError

FIRST_VERSION, END_VERSION = (1, 5, 3), (2,)
_EXTRA = "pip install 'aomgen[gpu]'"


def load_gsplat() -> ModuleType:
    """gsplat with its kernels, which are compiled at the first call on a machine (minutes).

    Raises:
        BackendError: No CUDA device, no gsplat, an unknown version, or kernels that do not build.
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
    """Refuse versions of gsplat whose functions are not known here.

    Raises:
        BackendError: Older than `FIRST_VERSION`, or `END_VERSION` and later.
    """
    numbers = tuple(int(part) for part in version.split("+")[0].split(".") if part.isdigit())
    if not FIRST_VERSION <= numbers < END_VERSION:
        first, end = (".".join(map(str, limit)) for limit in (FIRST_VERSION, END_VERSION))
        raise BackendError("gsplat", f"version {version}, want {first} or later and before {end}", _EXTRA)
