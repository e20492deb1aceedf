"""Choice of the lens model of a scan by held-out tracks.

A richer model always has a smaller error on the tracks to which it is fitted. Therefore the tracks are split into two
halves: cameras and lens are adjusted on one half under each model, and evaluated on the other half, for which only the
points are adjusted. If no richer model improves the held-out error, the stated values are used.
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

# Held-out evidence for a richer model: the mean gain over images in standard errors of that mean, and the relative
# reduction of the squared error. If the simpler model is correct, they are below 1 and 0.1 %; a distortion of two
# pixels at the border, or an error of 2 % of the focal length, gives 4 to 6 and 2 %.
MIN_SIGNIFICANCE = 3.0
# Least relative reduction: well below the 2 % of a real distortion.
MIN_GAIN = 0.005
# Errors are clipped at this multiple of their median, because larger ones are outliers.
OUTLIER_MEDIANS = 2.0
# Least relative standard deviation of a focal length; two halves of a scan cannot show a smaller one, because blur and
# compression displace the features of both halves in the same way.
MIN_FOCAL_SD = 0.002
# Cells across and down the image.
CELLS = np.array([8, 6])
# Features in a cell for a stable median.
MIN_FEATURES = 30
# The correct model has a misfit of 0.01 to 0.02 px; a pinhole model of a lens with a distortion of 5 px at the border
# has one of 0.07 px.
MAX_MISFIT_PX = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class LensChoice:
    """The lens model chosen by held-out tracks.

    Attributes:
        lens: Lens that was fitted to all tracks under the chosen model.
        model: The chosen model.
        gain: Relative reduction of the squared held-out error by the last model that was tested.
        significance: Mean gain over the images in standard errors.
    """

    lens: Lens
    model: LensModel
    gain: float = 0.0
    significance: float = 0.0


def choose_lens(model: pycolmap.Reconstruction, stated: Intrinsics | None, *, seed: int) -> LensChoice:
    """Choose the lens model of a mapped scan, and adjust the scan under it in place.

    Args:
        model: A reconstruction with one camera, which has the stated intrinsics if there are any.
        stated: The prior, or None if no intrinsics are stated.
    """
    halves = _halves(model, seed)
    errors: dict[LensModel, list[Array]] = {}

    def held_out_errors(kind: LensModel) -> list[Array]:
        if kind not in errors:
            fit, check = (_with_points(model, half) for half in halves)
            _adjust_lens(fit, kind)
            _copy_cameras(fit, check)
            adjust(check, points_only=True)
            errors[kind] = [(shifts**2).sum(1) for _, shifts in residuals(check)]
        return errors[kind]

    chosen, gain, significance = climb(held_out_errors, stated)
    lens = fit_lens(model, chosen, stated, seed=seed)
    return LensChoice(lens=lens, model=chosen, gain=gain, significance=significance)


def fit_lens(
    model: pycolmap.Reconstruction, kind: LensModel, stated: Intrinsics | None, *, seed: int
) -> Lens:
    """Adjust a scan in place under a lens model and the prior; return the lens."""
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
    """Find the richest lens model that held-out errors support; return it with gain and significance of the last test.

    Args:
        held_out_errors: Returns the squared errors by group under a model, see `compare`.
        stated: The prior; a calibrated distortion is not changed.
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
    """Combine the fitted focal length with the stated one, weighted by their standard deviations.

    Args:
        focal_sd: Relative standard deviation of the fitted focal length.
    """
    evidence, prior = 1 / max(focal_sd, MIN_FOCAL_SD) ** 2, 1 / stated.focal_sd**2
    toward = prior / (evidence + prior)
    fx, fy = (a ** (1 - toward) * b**toward for a, b in ((free.fx, stated.fx), (free.fy, stated.fy)))
    return replace(free, fx=fx, fy=fy)


def _convincing(gain: float, significance: float) -> bool:
    return gain >= MIN_GAIN and significance >= MIN_SIGNIFICANCE


def compare(before: list[Array], after: list[Array]) -> tuple[float, float]:
    """Compute the relative reduction of the squared error and its significance, from squared errors by group.

    Groups (images, or folds of one image) are the independent samples, because the errors within a group share a pose.
    Outliers are clipped at the same value before and after.
    """
    limit = OUTLIER_MEDIANS**2 * float(np.median(np.concatenate(before)))
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if len(b)]
    gains = np.array([np.minimum(b, limit).mean() - np.minimum(a, limit).mean() for b, a in pairs])
    level = float(np.mean([np.minimum(b, limit).mean() for b, _ in pairs]))
    spread = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
    return float(gains.mean() / max(level, 1e-12)), float(gains.mean() / max(spread, 1e-12))


def residuals(model: pycolmap.Reconstruction) -> list[tuple[Array, Array]]:
    """Return, for each registered image, the features (F, 2) of points and their offsets to these (F, 2), [px]."""
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
    """Adjust poses, points and the free parameters of a lens model; the focal length can be fixed."""
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
    """Compute the RMS over image cells of the median offset between features and their points, [px]."""
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
    """Refuse images with a distortion that no lens model describes.

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
