"""An OpenGL context without a window, from whichever driver this machine has."""

import os
from typing import Any

from aomgen.errors import BackendError

REMEDY = "install libegl1 libegl-mesa0 libgl1-mesa-dri (or libosmesa6), or set MUJOCO_GL to egl or osmesa"


def offscreen_context(width: int, height: int) -> Any:
    """A context of MuJoCo's kind (`make_current`, `free`) for images up to width x height, [px].

    `MUJOCO_GL` chooses the driver when set to egl or osmesa; else EGL is tried first.

    Raises:
        BackendError: No driver works.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    order = [wanted] if wanted in ("egl", "osmesa") else ["egl", "osmesa"]
    reasons = []
    for name in order:
        try:
            context = _create(name, width, height)
            context.make_current()
            return context
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            reasons.append(f"{name}: {error}")
    raise BackendError("offscreen rendering", f"no OpenGL driver works ({'; '.join(reasons)})", REMEDY)


def _create(name: str, width: int, height: int) -> Any:
    if name == "egl":
        from mujoco.egl import GLContext

        return GLContext(width, height)
    from mujoco.osmesa import GLContext

    return GLContext(width, height)
