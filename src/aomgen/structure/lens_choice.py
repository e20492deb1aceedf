"""Choice of the lens model that a scan supports, by tracks that the fit has not seen.

A richer model always fits better what it was fitted to. So the tracks are split in two halves:
cameras and optics are adjusted on one half under each model, and every result has to explain the
other half, where only the points may move. Where no richer model wins, the stated values stay.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from aomgen.core.lens import Lens
from aomgen.core.recording import Intrinsics
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.structure.sparse_model import (
    LensModel,
    adjust,
    camera_lens,
    free_lens,
    set_lens,
)

# Held-out evidence for a richer model: the mean gain over images in standard errors of that mean, and
# the share of the squared error it removes. Where the simpler model is right they stay below 1 and 0.1 %;
# a lens that bends the border by two pixels, or a focal length 2 % off, gives 4 to 6 and 2 %.
MIN_SIGNIFICANCE = 3.0
# Least relative gain: well below the 2 % that a real distortion gives.
MIN_GAIN = 0.005
# Errors above this many medians are outliers and count no more than this.
OUTLIER_MEDIANS = 2.0
# Best repeatability of focal lengths from two halves of a scan, as a share: blur and compression
# move the features of both halves alike.
MIN_FOCAL_SD = 0.002
# Cells across and down the image.
CELLS = np.array([8, 6])
# Features a cell for a stable median.
MIN_FEATURES = 30
# The right model leaves 0.01 to 0.02 px, a pinhole where the border is bent by 5 px leaves 0.07 px.
MAX_MISFIT_PX = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class LensChoice:
    """The lens model chosen on held-out tracks.

    Attributes:
        lens: Fitted to all tracks under the chosen model.
        model: What was refined.
        gain: Share of the squared held-out error that the richest model tried removes.
        significance: Mean gain of the images in standard errors.
    """

    lens: Lens
    model: LensModel
    gain: float = 0.0
    significance: float = 0.0


def choose_lens(model: pycolmap.Reconstruction, stated: Intrinsics | None, *, seed: int) -> LensChoice:
    """Choose the lens model of a mapped scan, and adjust the scan under it in place.

    Args:
        model: A model of one camera, which has the stated optics if there are any.
        stated: The prior, or None when nothing is known.
    """
    halves = _halves(model, seed)
    errors: dict[LensModel, list[Array]] = {}

    def held_out_errors(kind: LensModel) -> list[Array]:
        if kind not in errors:
            fit, check = (_with_points(model, half) for half in halves)
            _adjust_lens(fit, kind)
            _copy_cameras(fit, check)
            adjust(check, points_only=True)
            errors[kind] = compute_squared_errors(check)
        return errors[kind]

    chosen, gain, significance = climb(held_out_errors, stated)
    lens = fit_lens(model, chosen, stated, seed=seed)
    return LensChoice(lens=lens, model=chosen, gain=gain, significance=significance)


def fit_lens(
    model: pycolmap.Reconstruction, kind: LensModel, stated: Intrinsics | None, *, seed: int
) -> Lens:
    """Adjust a scan in place, with what a lens model leaves free under the prior; the lens."""
    _adjust_lens(model, kind)
    if stated is not None and kind != "stated":
        fits = [_with_points(model, half) for half in _halves(model, seed)]
        for fit in fits:
            _adjust_lens(fit, kind)
        one, other = (camera_lens(fit).fx for fit in fits)
        set_lens(model, lean_on_stated(camera_lens(model), stated, abs(np.log(one / other)) / 2))
        _adjust_lens(model, kind, focal=False)
    set_lens(model, camera_lens(model))
    return camera_lens(model)


def climb(
    held_out_errors: Callable[[LensModel], list[Array]], stated: Intrinsics | None
) -> tuple[LensModel, float, float]:
    """The richest lens model that held-out errors call for; gain and significance of the last one tried.

    Args:
        held_out_errors: Squared errors by group under a model, see `compare`.
        stated: The prior; a calibrated distortion is not touched.
    """
    base: LensModel = "focal" if stated is None else "stated"
    richer: tuple[LensModel, ...] = ("radial", "full")
    if stated is not None and stated.distortion is not None:
        richer = ("focal",) if stated.calibrated else ("full",)
    chosen, gain, significance = base, 0.0, 0.0
    for kind in richer:
        gain, significance = compare(held_out_errors(chosen), held_out_errors(kind))
        if not _convincing(gain, significance):
            break
        chosen = kind
    if chosen in ("radial", "full") and base == "stated":
        focal = held_out_errors("focal")
        enough = _convincing(*compare(held_out_errors("stated"), focal))
        if enough and not _convincing(*compare(focal, held_out_errors(chosen))):
            chosen = "focal"
    return chosen, gain, significance


def lean_on_stated(free: Lens, stated: Intrinsics, focal_sd: float) -> Lens:
    """The fitted lens with its focal length drawn towards the stated one, as their deviations say.

    Args:
        focal_sd: Of the fitted focal length, as a share of it.
    """
    evidence, prior = 1 / max(focal_sd, MIN_FOCAL_SD) ** 2, 1 / stated.focal_sd**2
    toward = prior / (evidence + prior)
    fx, fy = (a ** (1 - toward) * b**toward for a, b in ((free.fx, stated.fx), (free.fy, stated.fy)))
    return replace(free, fx=fx, fy=fy)


def _convincing(gain: float, significance: float) -> bool:
    return gain >= MIN_GAIN and significance >= MIN_SIGNIFICANCE


def compare(before: list[Array], after: list[Array]) -> tuple[float, float]:
    """Share of the squared error removed, and its significance, from squared errors by group.

    Groups (images, or folds of one image) are the independent samples; errors within one share
    a pose. Outliers are cut at the same value in both.
    """
    limit = OUTLIER_MEDIANS**2 * float(np.median(np.concatenate(before)))
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if len(b)]
    gains = np.array([np.minimum(b, limit).mean() - np.minimum(a, limit).mean() for b, a in pairs])
    level = float(np.mean([np.minimum(b, limit).mean() for b, _ in pairs]))
    spread = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
    return float(gains.mean() / max(level, 1e-12)), float(gains.mean() / max(spread, 1e-12))


def compute_squared_errors(model: pycolmap.Reconstruction) -> list[Array]:
    """Squared reprojection errors of each registered image, [px^2]."""
    return [(shifts**2).sum(1) for _, shifts in residuals(model)]


def residuals(model: pycolmap.Reconstruction) -> list[tuple[Array, Array]]:
    """Features (F, 2) of each registered image that show points, and their shifts to these (F, 2), [px]."""
    found = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        seen = image.get_observation_points2D()
        pixels = np.array([point.xy for point in seen], np.float64).reshape(-1, 2)
        points = np.array([model.points3D[point.point3D_id].xyz for point in seen], np.float64).reshape(-1, 3)
        T_cam_recon = image.cam_from_world()
        points_cam = points @ T_cam_recon.matrix()[:, :3].T + T_cam_recon.translation
        drawn = np.asarray(model.cameras[image.camera_id].img_from_cam(points_cam)).reshape(-1, 2)
        found.append((pixels, drawn - pixels))
    return found


def _adjust_lens(model: pycolmap.Reconstruction, kind: LensModel, *, focal: bool = True) -> None:
    """Adjust poses, points and what a lens model leaves free; the focal length can be held."""
    for camera in model.cameras.values():
        free_lens(camera, kind)
    adjust(model, focal=focal and kind != "stated", distortion=kind in ("radial", "full"))


def _halves(model: pycolmap.Reconstruction, seed: int) -> list[Array]:
    return np.array_split(np.random.default_rng(seed).permutation(sorted(model.points3D)), 2)


def _with_points(model: pycolmap.Reconstruction, point_ids: Array) -> pycolmap.Reconstruction:
    copy, keep = pycolmap.Reconstruction(model), set(point_ids.tolist())
    for point_id in list(copy.points3D):
        if point_id not in keep:
            copy.delete_point3D(point_id)
    return copy


def _copy_cameras(source: pycolmap.Reconstruction, target: pycolmap.Reconstruction) -> None:
    for camera_id, camera in source.cameras.items():
        target.cameras[camera_id].model = camera.model
        target.cameras[camera_id].params = camera.params
    for image_id in source.reg_image_ids():
        frame_id = target.images[image_id].frame_id
        target.frames[frame_id].rig_from_world = source.frames[frame_id].rig_from_world


def lens_misfit_px(model: pycolmap.Reconstruction) -> float:
    """Root mean square, over cells of the image, of the median shift of features from their points, [px]."""
    found = residuals(model)
    pixels, shifts = (np.concatenate(part) for part in zip(*found, strict=True))
    camera = next(iter(model.cameras.values()))
    cells = np.clip((pixels / [camera.width, camera.height] * CELLS).astype(int), 0, CELLS - 1) @ [
        CELLS[1],
        1,
    ]
    medians = [
        np.median(shifts[cells == cell], axis=0)
        for cell in range(CELLS.prod())
        if np.sum(cells == cell) >= MIN_FEATURES
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(medians), axis=1)))) if medians else 0.0


def require_lens_fits(misfit_px: float, where: str) -> None:
    """Refuse images whose lens no model describes.

    Raises:
        ReconstructionError: The remaining displacement exceeds its limit.
    """
    if not misfit_px <= MAX_MISFIT_PX:
        raise ReconstructionError(
            where,
            f"has a distortion that no lens model explains: features are displaced by {misfit_px:.2f} px "
            f"at the same positions of all images, limit {MAX_MISFIT_PX:.2f} px",
            "record with the main lens, without fisheye, zoom, stabilisation or cropping",
        )
