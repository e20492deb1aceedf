"""Loading and saving of the Gaussians stage."""

from pathlib import Path

import numpy as np

from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.structure import Structure
from aomgen.gaussians.train import GaussiansParams, HeldOut, TrainedScene, train_scene
from aomgen.io.atomic import write_json
from aomgen.io.images import read_image, resize, write_image
from aomgen.io.jsonfile import read_json
from aomgen.io.ply import read_gaussians, write_gaussians
from aomgen.splatting.checkpoint import Checkpoint

GAUSSIANS_FILE = "gaussians.ply"
METRICS_FILE = "metrics.json"
STRIP_FILE = "heldout.png"
CHECKPOINT_FILE = "training.checkpoint"


def run_gaussians(
    structure: Structure,
    images: dict[str, Path],
    folder: Path,
    progress: Progress,
    params: GaussiansParams | None = None,
) -> TrainedScene:
    """Train (see `train_scene`) and write `gaussians.ply`, `metrics.json` and `heldout.png`.

    `training.checkpoint` lies in the folder while this works: a killed run continues there.
    """
    images_srgb = {name: read_image(path) for name, path in sorted(images.items())}
    checkpoint = Checkpoint(path=folder / CHECKPOINT_FILE)
    scene = train_scene(structure, images_srgb, params or GaussiansParams(), progress, checkpoint=checkpoint)
    write_gaussians(folder / GAUSSIANS_FILE, scene.gaussians_recon)
    write_json(folder / METRICS_FILE, scene.figures)
    if scene.heldout:
        write_image(folder / STRIP_FILE, _strip(scene.heldout, images_srgb))
    checkpoint.path.unlink()
    progress(1.0, "Gaussians written")
    return scene


def load_gaussians(folder: Path) -> TrainedScene:
    """Read what `run_gaussians` wrote; rendered held-out images are not kept.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: As their names say.
    """
    figures = read_json(folder / METRICS_FILE)
    nothing = np.zeros((0, 0, 3), np.uint8)
    return TrainedScene(
        gaussians_recon=_load(folder),
        heldout={
            name: HeldOut(psnr_db=view["psnr"], ssim=view["ssim"], rendered_srgb=nothing)
            for name, view in figures.get("heldout", {}).items()
        },
        figures=figures,
    )


def _load(folder: Path) -> Gaussians:
    return read_gaussians(folder / GAUSSIANS_FILE)


def _strip(heldout: dict[str, HeldOut], images_srgb: dict[str, np.ndarray]) -> np.ndarray:
    """Photograph above rendering, side by side over the held-out images."""
    columns = []
    for name, view in heldout.items():
        height, width = view.rendered_srgb.shape[:2]
        small = (round(320 * width / max(width, 1)), round(320 * height / max(width, 1)))
        columns.append(
            np.concatenate([resize(images_srgb[name], *small), resize(view.rendered_srgb, *small)], axis=0)
        )
    return np.concatenate(columns, axis=1)
