"""The scene as Gaussians: started from dense points, trained, cleaned and evaluated on held-out images."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.progress import Progress, part
from aomgen.core.structure import Structure, held_out
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.errors import CorruptArtifactError, ReconstructionError
from aomgen.gaussians.dense_points import DensifyParams, densify
from aomgen.gaussians.depth_fusion import Samples, join_samples
from aomgen.io.reuse import warn_of_file
from aomgen.splatting.checkpoint import Checkpoint
from aomgen.splatting.metrics import psnr, ssim
from aomgen.splatting.rasterizer import render
from aomgen.splatting.training import TrainingParams, train


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussiansParams:
    """Effort and limits of the stage.

    Attributes:
        densify: Parameters of the initial points.
        training: Parameters of the training.
        near_share: Gaussians nearer to a camera than this share of its nearest depth are removed.
        min_psnr_db: Mean over the held-out images below which the scene is refused.
    """

    densify: DensifyParams = field(default_factory=DensifyParams)
    training: TrainingParams = field(
        default_factory=lambda: TrainingParams(iterations=1400, max_gaussians=110_000)
    )
    near_share: float = 0.25
    min_psnr_db: float = 15.0
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingViews:
    """Initial Gaussians and training images.

    Attributes:
        surface: Points (P, 3) on surfaces, recon frame.
        initial: A Gaussian for each of them, then one for each point of the far shell.
        cameras: Cameras of the training images, recon frame.
        images_srgb: (H, W, 3) uint8 each.
        test: Names of the images that are held out and have a camera.
    """

    surface: Array
    initial: Gaussians
    cameras: list[Camera]
    images_srgb: list[NDArray[np.uint8]]
    test: list[str]


def select_training_views(
    structure: Structure, images_srgb: dict[str, NDArray[np.uint8]], params: DensifyParams, progress: Progress
) -> TrainingViews:
    """Split a scan into training and held-out images and initialize the Gaussians.

    Args:
        images_srgb: All scan images (H, W, 3) uint8 by name; those without a camera are ignored.
        params: Parameters of the dense points, which are computed from the training images only.
    """
    test = held_out(list(images_srgb))
    known = [name for name in structure.cameras_recon if name in images_srgb]
    learned = {name: images_srgb[name] for name in known if name not in test}
    surface, shell = densify(structure, learned, params, progress)
    return TrainingViews(
        surface=surface.points_recon,
        initial=initial_gaussians(surface, shell),
        cameras=[structure.cameras_recon[name] for name in learned],
        images_srgb=list(learned.values()),
        test=[name for name in test if name in structure.cameras_recon],
    )


def train_scene(
    structure: Structure,
    images_srgb: dict[str, NDArray[np.uint8]],
    params: GaussiansParams,
    progress: Progress,
    *,
    checkpoint: Checkpoint | None = None,
) -> tuple[Gaussians, dict[str, NDArray[np.uint8]], dict[str, Any]]:
    """Train Gaussians on a scan and evaluate them on held-out images.

    Args:
        images_srgb: All scan images (H, W, 3) uint8 by name; those without a camera are ignored.
        checkpoint: File from which the training continues after a kill. If it cannot be used (damaged, or of other
            inputs), the training starts over with a warning.

    Returns:
        The scene, background included, recon frame; renderings (H, W, 3) uint8 of the held-out images by name; and metrics
        (JSON values).

    Raises:
        ReconstructionError: The held-out images are not reproduced at all.

    Source: Kerbl et al., "3D Gaussian splatting", 2023; AOMGen, sec. 4.1.
    """
    views = select_training_views(structure, images_srgb, params.densify, part(progress, 0.0, 0.25))
    training = partial(
        train, views.initial, views.cameras, views.images_srgb, params.training, part(progress, 0.25, 0.95)
    )
    try:
        trained = training(np.random.default_rng(params.seed), checkpoint=checkpoint)
    except CorruptArtifactError as error:
        if checkpoint is None:
            raise
        warn_of_file(error.where, error.problem, "the training starts over")
        checkpoint.path.unlink()
        trained = training(np.random.default_rng(params.seed), checkpoint=checkpoint)
    trained = without_floaters(trained, views.cameras, views.surface, params.near_share)
    evaluated = {
        name: evaluate_view(trained, structure.cameras_recon[name], images_srgb[name]) for name in views.test
    }
    scores = {name: {"psnr": db, "ssim": similarity} for name, (db, similarity, _) in evaluated.items()}
    means = {
        key: float(np.mean([item[key] for item in scores.values()])) for key in ("psnr", "ssim") if scores
    }
    if scores and not means["psnr"] >= params.min_psnr_db:
        raise ReconstructionError(
            "gaussians",
            f"held-out images are reproduced with {means['psnr']:.1f} dB, at least {params.min_psnr_db:.1f} are needed",
            "check for motion blur, changing light and moving objects in the scan",
        )
    figures = {
        "heldout_psnr": means.get("psnr"),
        "heldout_ssim": means.get("ssim"),
        "gaussians": len(trained),
        "initial_points": len(views.initial),
        "shell_points": len(views.initial) - len(views.surface),
        "heldout": scores,
    }
    return trained, {name: rendered for name, (_, _, rendered) in evaluated.items()}, figures


def initial_gaussians(surface: Samples, shell: Samples) -> Gaussians:
    """Create one Gaussian for each point: as wide as the distance to its neighbors, and flat along a known normal."""
    dense = join_samples([surface, shell])
    points, of_shell = dense.points_recon, np.arange(len(dense.weights)) >= len(surface.weights)
    spacing = np.empty(len(points))
    for which in (of_shell, ~of_shell):
        if which.sum() > 3:
            distances, _ = cKDTree(points[which]).query(points[which], k=4)
            spacing[which] = np.sqrt((distances[:, 1:] ** 2).mean(1))
    spacing = np.clip(spacing, 0.4 * dense.footprints, 1.6 * dense.footprints)
    known = np.linalg.norm(dense.normals_recon, axis=1) > 0.5
    scales = np.repeat(0.6 * spacing[:, None], 3, axis=1)
    scales[known, 2] *= 0.3
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    quats[known] = quat_from_matrix(_frames(dense.normals_recon[known]))
    colors = (dense.colors_srgb / 255.0 - 0.5) / SH_C0
    return Gaussians(
        means=points.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=np.full(len(points), 0.6, np.float32),
        sh=colors[:, None, :].astype(np.float32),
    )


def without_floaters(
    gaussians: Gaussians, cameras: list[Camera], surface: Array, near_share: float
) -> Gaussians:
    """Remove Gaussians that float in front of a camera or far from all surfaces.

    Args:
        surface: Points (P, 3) on surfaces, which determine the distance of the scene from each camera.
        near_share: See `GaussiansParams`.
    """
    keep = np.ones(len(gaussians), bool)
    tree = cKDTree(surface)
    for camera in cameras:
        nearest, _ = tree.query(camera.center)
        keep &= np.linalg.norm(gaussians.means - camera.center, axis=1) > near_share * nearest
    # The fifth neighbor of an isolated Gaussian is more than 20 times as far as the median; it is removed if it is faint
    # and close to the cameras.
    distances, _ = cKDTree(gaussians.means).query(gaussians.means, k=6)
    alone = distances[:, -1] > 20 * np.median(distances[:, -1])
    inside = np.linalg.norm(gaussians.means - np.median(surface, 0), axis=1) < 2 * max(
        float(np.linalg.norm(camera.center - np.median(surface, 0))) for camera in cameras
    )
    return gaussians.select(keep & ~(alone & inside & (gaussians.opacities < 0.1)))


def evaluate_view(
    gaussians: Gaussians, camera: Camera, image_srgb: NDArray[np.uint8]
) -> tuple[float, float, NDArray[np.uint8]]:
    """Compute PSNR [dB] and SSIM of a rendered view, of the whole image without exposure fit, and the view (H, W, 3)."""
    drawn = np.clip(render(gaussians, camera).rgb, 0.0, 1.0)
    photograph = image_srgb.astype(np.float32) / 255.0
    return psnr(drawn, photograph), ssim(drawn, photograph), np.round(drawn * 255).astype(np.uint8)


def _frames(normals: Array) -> Array:
    """Compute rotations (N, 3, 3) whose third column is the normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], 2)


def coarse(params: GaussiansParams) -> GaussiansParams:
    """Reduce the effort of the parameters to a fraction, for previews and tests."""
    return replace(
        params,
        densify=replace(params.densify, target_points=15_000, shell_points=2_000, planes=64),
        training=replace(params.training, iterations=200, sh_degree=0, max_gaussians=20_000),
    )
