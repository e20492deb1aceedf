"""Trained Gaussians of the scene, judged by held-out images. [paper 4.1]"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.core.progress import Progress
from aomgen.core.structure import Structure
from aomgen.gaussians.train import GaussiansParams, HeldOut, TrainedScene, train_scene
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
    scene = train_in(folder, results.structure, results.scan_images, progress, params)
    views = list(scene.heldout.values())
    return {
        "gaussians": len(scene.gaussians_recon),
        "heldout_psnr": float(np.mean([view.psnr_db for view in views])) if views else 0.0,
        "heldout_ssim": float(np.mean([view.ssim for view in views])) if views else 0.0,
    }


def train_in(
    folder: Path, structure: Structure, images: dict[str, Path], progress: Progress, params: GaussiansParams
) -> TrainedScene:
    """Train (see `train_scene`) and write `gaussians.ply`, `metrics.json` and `heldout.png`.

    `training.checkpoint` lies in the folder while this works: a killed run continues there.
    """
    images_srgb = {name: read_image(path) for name, path in sorted(images.items())}
    checkpoint = Checkpoint(path=folder / CHECKPOINT_FILE)
    scene = train_scene(structure, images_srgb, params, progress, checkpoint=checkpoint)
    write_gaussians(folder / GAUSSIANS_FILE, scene.gaussians_recon)
    write_json(folder / METRICS_FILE, scene.figures)
    if scene.heldout:
        write_image(folder / STRIP_FILE, _strip(scene.heldout, images_srgb))
    checkpoint.path.unlink()
    return scene


def _strip(heldout: dict[str, HeldOut], images_srgb: dict[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Photograph above rendering, side by side over the held-out images."""
    columns = []
    for name, view in heldout.items():
        height, width = view.rendered_srgb.shape[:2]
        small = (STRIP_WIDTH, round(STRIP_WIDTH * height / width))
        columns.append(
            np.concatenate([resize(images_srgb[name], *small), resize(view.rendered_srgb, *small)], axis=0)
        )
    return np.concatenate(columns, axis=1)
