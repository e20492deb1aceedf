"""`python -m benchmarks training`: quality of held-out views over the seconds of training."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.capture.read import read_capture
from aomgen.core.camera import Camera
from aomgen.core.progress import silent
from aomgen.core.project import Project
from aomgen.core.structure import Structure
from aomgen.gaussians.train import (
    GaussiansParams,
    TrainingViews,
    evaluate_view,
    select_training_views,
    without_floaters,
)
from aomgen.io.artifact import load_artifact
from aomgen.io.images import read_image
from aomgen.splatting.checkpoint import TrainingState
from aomgen.splatting.metrics import psnr
from aomgen.splatting.training import finish_training, learning, scene_extent, start_training

FIRST_STAGE, STRUCTURE_FOLDER = "structure", "01_structure"
LIMIT_SECONDS = 120.0


class Clock:
    """Seconds of training, wall and processor; time between `stop` and `start` is not counted."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0
        self.start()

    def start(self) -> None:
        """Start counting."""
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def stop(self) -> None:
        """Add the time since `start` or the last `stop`."""
        wall, cpu = time.monotonic(), time.process_time()
        self.wall, self.cpu = self.wall + wall - self._wall, self.cpu + cpu - self._cpu
        self._wall, self._cpu = wall, cpu


def run_training(
    capture_folder: Path,
    out: Path | None,
    run_project: Callable[..., None],
    *,
    iterations: int = 0,
    every_seconds: float = 15.0,
) -> dict[str, Any]:
    """Measure the PSNR of a scan's held-out views over the seconds of training.

    Args:
        capture_folder: A capture; no truth is needed.
        out: Run folder, continued when it exists; a temporary one when None.
        run_project: Runs a project up to a stage.
        iterations: Number of steps instead of the project's own; 0 keeps it.
        every_seconds: Training time between two evaluations.

    Returns:
        `curve`, a list of seconds (wall), cpu_seconds, iteration, gaussians, psnr, ssim and
        psnr_gain_fitted (after each rendered color channel was multiplied by its best gain, which shows
        the effect of the camera's exposure); the last values; the best within 120 s; seconds of the
        dense start.
    """
    with tempfile.TemporaryDirectory() as scratch:
        out = (out or Path(scratch) / "run").resolve()
        project = Project(capture=capture_folder.resolve(), out=out)
        run_project(project, until=FIRST_STAGE)
        structure = load_artifact(out / STRUCTURE_FOLDER, "structure", Structure)
    images = {path.name: read_image(path) for path in read_capture(capture_folder).scan_images}
    default = GaussiansParams()
    params = replace(
        default,
        training=replace(
            default.training,
            iterations=iterations or project.iterations,
            max_gaussians=project.gaussians,
        ),
    )
    clock = Clock()
    views = select_training_views(structure, images, params.densify, silent)
    clock.stop()
    held_out = [(structure.cameras_recon[name], images[name]) for name in views.test]
    curve = training_curve(views, held_out, params, every_seconds)
    soon = [point["psnr"] for point in curve if point["seconds"] <= LIMIT_SECONDS]
    return {
        "curve": curve,
        "dense_start_seconds": round(clock.wall, 2),
        "heldout_psnr": curve[-1]["psnr"],
        "heldout_psnr_gain_fitted": curve[-1]["psnr_gain_fitted"],
        "heldout_psnr_within_120_s": max(soon, default=None),
        "heldout_ssim": curve[-1]["ssim"],
        "training_seconds": curve[-1]["seconds"],
    }


def training_curve(
    views: TrainingViews,
    held_out: list[tuple[Camera, np.ndarray]],
    params: GaussiansParams,
    every_seconds: float,
) -> list[dict[str, Any]]:
    """Train, and evaluate the held-out views every few seconds and at the end."""
    state = start_training(views.initial, views.cameras, params.training, np.random.default_rng(params.seed))
    extent = scene_extent(views.initial, views.cameras)
    curve: list[dict[str, Any]] = []
    clock = Clock()
    for _ in learning(state, views.cameras, views.images_srgb, params.training, extent):
        clock.stop()
        if clock.wall >= every_seconds * (len(curve) + 1) or state.iteration == params.training.iterations:
            curve.append(_point(state, views, held_out, params, clock))
            clock.start()
    return curve


def _point(
    state: TrainingState,
    views: TrainingViews,
    held_out: list[tuple[Camera, np.ndarray]],
    params: GaussiansParams,
    clock: Clock,
) -> dict[str, Any]:
    gaussians = finish_training(state, params.training)
    gaussians = without_floaters(gaussians, views.cameras, views.surface, params.near_share)
    evaluated = [evaluate_view(gaussians, camera, image) for camera, image in held_out]
    fitted = [
        gain_fitted_psnr(rendered, image)
        for (_, _, rendered), (_, image) in zip(evaluated, held_out, strict=True)
    ]
    return {
        "seconds": round(clock.wall, 2),
        "cpu_seconds": round(clock.cpu, 2),
        "iteration": state.iteration,
        "gaussians": len(gaussians),
        "psnr": float(np.mean([psnr_db for psnr_db, _, _ in evaluated])),
        "psnr_gain_fitted": float(np.mean(fitted)),
        "ssim": float(np.mean([similarity for _, similarity, _ in evaluated])),
    }


def gain_fitted_psnr(rendered_srgb: NDArray[np.uint8], image_srgb: NDArray[np.uint8]) -> float:
    """Compute the PSNR of a rendering (H, W, 3) after the best gain for every color channel, [dB]."""
    drawn, photograph = (image.reshape(-1, 3) / 255.0 for image in (rendered_srgb, image_srgb))
    gains = (drawn * photograph).sum(0) / np.maximum((drawn * drawn).sum(0), 1e-12)
    return psnr(drawn * gains, photograph)
