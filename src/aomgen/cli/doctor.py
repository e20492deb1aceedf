"""What `aomgen doctor` looks at."""

import importlib.util

from aomgen.errors import AomgenError
from aomgen.pipeline.environment import gl_problem
from aomgen.robots.offscreen import REMEDY


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
    problem = gl_problem()
    rows.append(
        ("OpenGL", f"{problem}: {REMEDY}" if problem else "", "robot silhouettes (alignment, clock offset)")
    )
    rows.append(("weights", _weights_problem(), "part masks from prompts"))
    return rows


def _engine_problem() -> str:
    from aomgen.splatting.native import library

    try:
        library()
    except AomgenError as error:
        return str(error)
    return ""


def _weights_problem() -> str:
    from aomgen.segmentation.weights import find_weights

    try:
        find_weights()
    except AomgenError as error:
        return str(error)
    return ""
