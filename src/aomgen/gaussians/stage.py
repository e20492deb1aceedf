"""Trained Gaussians of the scene, judged by held-out images. [paper 4.1]"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.core.progress import Progress
from aomgen.core.structure import Structure
from aomgen.gaussians.train import GaussiansParams, train_scene
from aomgen.io.atomic import write_json
from aomgen.io.images import read_image, resize, write_image
from aomgen.io.ply import write_gaussians
from aomgen.results import GAUSSIANS_FILE, Results
from aomgen.splatting.checkpoint import Checkpoint

METRICS_FILE = "metrics.json"
STRIP_FILE = "heldout.png"
CHECKPOINT_FILE = "training.checkpoint"
# Width of an image in the strip, [px].
STRIP_WIDTH = 320


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Train as the project says."""
    project, params = results.project, results.params("gaussians", GaussiansParams())
    training = replace(params.training, iterations=project.iterations, max_gaussians=project.gaussians)
    params = replace(params, training=training)
    figures = train_in(folder, results.structure, results.scan_images, progress, params)
    return {
        "gaussians": figures["gaussians"],
        "heldout_psnr": figures["heldout_psnr"] or 0.0,
        "heldout_ssim": figures["heldout_ssim"] or 0.0,
    }


def train_in(
    folder: Path, structure: Structure, images: dict[str, Path], progress: Progress, params: GaussiansParams
) -> dict[str, Any]:
    """Train (see `train_scene`), write `gaussians.ply`, `metrics.json` and `heldout.png`, and return the metrics.

    The folder contains `training.checkpoint` during the training, from which an interrupted run continues.
    """
    images_srgb = {name: read_image(path) for name, path in sorted(images.items())}
    checkpoint = Checkpoint(path=folder / CHECKPOINT_FILE)
    gaussians, renderings, figures = train_scene(
        structure, images_srgb, params, progress, checkpoint=checkpoint
    )
    write_gaussians(folder / GAUSSIANS_FILE, gaussians)
    write_json(folder / METRICS_FILE, figures)
    if renderings:
        write_image(folder / STRIP_FILE, _strip(renderings, images_srgb))
    checkpoint.path.unlink()
    return figures


def _strip(
    renderings: dict[str, NDArray[np.uint8]], images_srgb: dict[str, NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """Photograph above rendering, side by side over the held-out images."""
    columns = []
    for name, rendered in renderings.items():
        height, width = rendered.shape[:2]
        small = (STRIP_WIDTH, round(STRIP_WIDTH * height / width))
        pair = [resize(images_srgb[name], *small), resize(rendered, *small)]
        columns.append(np.concatenate(pair, axis=0))
    return np.concatenate(columns, axis=1)
