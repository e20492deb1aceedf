"""Check whether this machine satisfies the requirements of the stages."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from aomgen.errors import AomgenError, BackendError, StorageError
from aomgen.replacement.diffusion import EXTRA as DIFFUSION_REMEDY
from aomgen.robots.silhouette import REMEDY as GL_REMEDY
from aomgen.segmentation.sam2_weights import find_sam2
from aomgen.segmentation.weights import ensure_weights, find_weights
from aomgen.splatting.native import library

# Optional modules that a stage imports, and the command that installs them.
MODULES = {
    "structure": (("pycolmap",), "pip install 'aomgen[reconstruct]'"),
    "gaussians": (("torch",), "pip install 'aomgen[reconstruct]'"),
}
MOBILE_SAM = (("onnxruntime",), "pip install 'aomgen[reconstruct]'")
SAM2 = (("torch", "transformers", "safetensors"), "pip install 'aomgen[sam2]'")
DIFFUSION = (("torch", "diffusers", "transformers", "safetensors"), DIFFUSION_REMEDY)
# Stages that render the robot with OpenGL.
DRAWS_ROBOT = ("alignment", "parts", "motion", "twin")
EVERYTHING = (*MODULES, *DRAWS_ROBOT, "replacement")
# A broken driver can abort the process that creates a context, so this is tested in a child process.
GL_PROBE = "from aomgen.robots.silhouette import offscreen_context; offscreen_context(8, 8).free()"
# Time after which the test is stopped, [s]; a working driver takes about a second.
GL_TIMEOUT_S = 60.0
# Smallest free space for the results, [bytes]; a run with the bundled recording takes 180 MB.
MIN_FREE = 250 << 20


def require_environment(
    stages: Collection[str], segmenter: str, *, has_masks: bool, diffusion: bool = False, repair: bool = False
) -> None:
    """Check that this machine can execute stages.

    Args:
        stages: Names of the stages to be executed.
        segmenter: Segmenter of the project.
        has_masks: The capture contains masks.
        diffusion: The project uses diffusion pipelines.
        repair: Download damaged weights again.

    Raises:
        BackendError: A module, weight file, the native library or an OpenGL driver is missing.
    """
    for stage, (modules, remedy) in MODULES.items():
        if stage in stages:
            _require_modules(modules, remedy)
    if stages:
        library()
    if "parts" in stages and not (segmenter == "auto" and has_masks):
        if segmenter in ("auto", "mobile_sam"):
            _require_modules(*MOBILE_SAM)
            (ensure_weights if repair else find_weights)("mobile_sam")
        else:
            find_sam2(segmenter)
            _require_modules(*SAM2)
    if "replacement" in stages and diffusion:
        _require_modules(*DIFFUSION)
    problem = gl_problem() if set(DRAWS_ROBOT) & set(stages) else ""
    if problem:
        raise BackendError("OpenGL", problem, GL_REMEDY)


def require_room(out: Path) -> None:
    """Check that a folder of results can be written.

    Raises:
        StorageError: The path is a file or not writable, or its disk is nearly full.
    """
    there = next(folder for folder in (out, *out.parents) if folder.exists())
    if not there.is_dir():
        raise StorageError(there, "is a file, results need a folder", "choose another `out`")
    if not os.access(there, os.W_OK | os.X_OK):
        raise StorageError(there, "is not writable", "choose another `out`")
    free = shutil.disk_usage(there).free
    if not free >= MIN_FREE:
        problem = f"has {free >> 20} MB left on its disk, expected at least {MIN_FREE >> 20}"
        raise StorageError(there, problem, "free space or choose another `out`")


def gl_problem() -> str:
    """Describe why no OpenGL context can be created on this machine; empty if one can."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", GL_PROBE], capture_output=True, text=True, timeout=GL_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return f"no context within {GL_TIMEOUT_S:g} s"
    if done.returncode == 0:
        return ""
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


def _require_modules(modules: tuple[str, ...], remedy: str) -> None:
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise BackendError(module, "is not installed", remedy)


def diagnose() -> list[tuple[str, str, str]]:
    """List the components that runs use, each with its problem on this machine (or "") and its purpose."""
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
    problem = gl_problem()
    return [
        *rows,
        ("engine", _problem_of(library), "rendering and training on the CPU"),
        (
            "OpenGL",
            f"{problem}: {GL_REMEDY}" if problem else "",
            "robot silhouettes (alignment, clock offset)",
        ),
        ("weights", _problem_of(find_weights), "part masks from prompts"),
    ]


def _problem_of(check: Callable[[], object]) -> str:
    try:
        check()
    except AomgenError as error:
        return str(error)
    return ""
