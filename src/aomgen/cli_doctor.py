"""What `aomgen doctor` looks at."""

import importlib.util
import os
import subprocess
import sys

from aomgen.errors import AomgenError

# A GL context can abort the whole process when the driver is broken, so it is tried in a child.
GL_PROBE = (
    "import os; os.environ.setdefault('MUJOCO_GL', 'egl'); import mujoco;"
    "m = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light/></worldbody></mujoco>');"
    "mujoco.Renderer(m, 8, 8).close()"
)


def diagnose() -> list[tuple[str, str, str]]:
    """Rows of (part, problem or "", what it is for)."""
    rows = []
    for module, extra, purpose in (
        ("mujoco", "", "physics"),
        ("pxr", "", "USD assets"),
        ("av", "", "video"),
        ("torch", "reconstruct", "training of Gaussians"),
        ("pycolmap", "reconstruct", "structure from motion"),
        ("onnxruntime", "reconstruct", "segmentation"),
    ):
        found = importlib.util.find_spec(module) is not None
        remedy = f"pip install 'aomgen[{extra}]'" if extra else "pip install aomgen"
        rows.append((module, "" if found else f"missing: {remedy}", purpose))
    rows.append(("engine", _engine_problem(), "rendering and training on the CPU"))
    rows.append(("OpenGL", _gl_problem(), "robot silhouettes (alignment, clock offset)"))
    rows.append(("weights", _weights_problem(), "part masks from prompts"))
    return rows


def _engine_problem() -> str:
    from aomgen.splatting.native import library

    try:
        library()
    except AomgenError as error:
        return str(error)
    return ""


def _gl_problem() -> str:
    result = subprocess.run([sys.executable, "-c", GL_PROBE], capture_output=True, env=os.environ, timeout=60)
    return "" if result.returncode == 0 else "missing: apt-get install libegl1 libgl1-mesa-dri"


def _weights_problem() -> str:
    from aomgen.reconstruction.masks.weights import find_weights

    try:
        find_weights()
    except AomgenError as error:
        return str(error)
    return ""
