"""Is there lens distortion? Decided on evidence that the fit has not seen.

A lens with four more parameters always fits better what it was fitted to. So the tracks are split
in two halves: cameras and optics are adjusted on one half, as a pinhole and with distortion, and
both answers have to explain the other half, where only the points may move.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap

from aomgen.core.lens import Lens
from aomgen.core.values import Array
from aomgen.reconstruction.cameras.mapped import adjust, lens_of, opencv_params

# Held-out evidence for distortion: the mean gain over images in standard errors of that mean, and
# the share of the squared error it removes. Pinhole captures stay below 0 and -0.1 %; a lens that
# bends the border by a pixel and a half gives 5 standard errors and 0.7 %.
MIN_SIGNIFICANCE = 4.0
MIN_GAIN = 0.005
# Errors above this many medians are outliers and count no more than this.
OUTLIER_MEDIANS = 4.0
MAX_ITERATIONS = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class LensChoice:
    """What held-out tracks say about distortion.

    Attributes:
        lens: The fit with distortion.
        gain: Share of the pinhole's squared held-out error that distortion removes.
        significance: Mean gain of the images in standard errors.
    """

    lens: Lens
    gain: float
    significance: float

    @property
    def bends(self) -> bool:
        """Whether the distortion is real and can be undone."""
        return self.gain >= MIN_GAIN and self.significance >= MIN_SIGNIFICANCE and self.lens.valid


def choose_lens(model: pycolmap.Reconstruction, *, focal_known: bool, seed: int) -> LensChoice:
    """Compare pinhole and distortion on a mapped model, which is not changed.

    Args:
        model: A model of one pinhole camera.
        focal_known: Keep the focal lengths; otherwise both candidates refine them.
        seed: Of the split.
    """
    point_ids = np.array(sorted(model.points3D))
    order = np.random.default_rng(seed).permutation(len(point_ids))
    fitted, held_out = np.array_split(point_ids[order], 2)
    errors: list[list[Array]] = []
    lens = lens_of(next(iter(model.cameras.values())))
    for bends in (False, True):
        fit = _with_points(model, fitted)
        if bends:
            _allow_distortion(fit)
        adjust(fit, _options(focal=not focal_known, distortion=bends))
        lens = lens_of(next(iter(fit.cameras.values())))
        check = _with_points(model, held_out)
        _copy_cameras(fit, check)
        adjust(check, _options(points_only=True))
        errors.append(squared_errors(check))
    gain, significance = compare(errors[0], errors[1])
    return LensChoice(lens=lens, gain=gain, significance=significance)


def compare(before: list[Array], after: list[Array]) -> tuple[float, float]:
    """Share of the squared error removed, and its significance, from squared errors by group.

    Groups (images, or folds of one image) are the independent witnesses; errors within one share
    a pose. Outliers are cut at the same value in both.
    """
    limit = OUTLIER_MEDIANS**2 * float(np.median(np.concatenate(before)))
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if len(b)]
    gains = np.array([np.minimum(b, limit).mean() - np.minimum(a, limit).mean() for b, a in pairs])
    level = float(np.mean([np.minimum(b, limit).mean() for b, _ in pairs]))
    spread = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
    return float(gains.mean() / max(level, 1e-12)), float(gains.mean() / max(spread, 1e-12))


def squared_errors(model: pycolmap.Reconstruction) -> list[Array]:
    """Squared reprojection errors of each registered image, [px^2]."""
    errors = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            errors.append(np.zeros(0))
            continue
        points = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        points_cam = points @ image.cam_from_world().matrix()[:, :3].T + image.cam_from_world().translation
        drawn = np.asarray(model.cameras[image.camera_id].img_from_cam(points_cam))
        errors.append(((drawn - np.array([point.xy for point in seen])) ** 2).sum(1))
    return errors


def _options(
    *, focal: bool = False, distortion: bool = False, points_only: bool = False
) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = focal
    options.refine_extra_params = distortion
    options.refine_rig_from_world = not points_only
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    return options


def _with_points(model: pycolmap.Reconstruction, point_ids: Array) -> pycolmap.Reconstruction:
    copy, keep = pycolmap.Reconstruction(model), set(point_ids.tolist())
    for point_id in list(copy.points3D):
        if point_id not in keep:
            copy.delete_point3D(point_id)
    return copy


def _allow_distortion(model: pycolmap.Reconstruction) -> None:
    for camera in model.cameras.values():
        params = opencv_params(lens_of(camera))
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = params


def _copy_cameras(source: pycolmap.Reconstruction, target: pycolmap.Reconstruction) -> None:
    for camera_id, camera in source.cameras.items():
        target.cameras[camera_id].model = camera.model
        target.cameras[camera_id].params = camera.params
    for image_id in source.reg_image_ids():
        frame_id = target.images[image_id].frame_id
        target.frames[frame_id].rig_from_world = source.frames[frame_id].rig_from_world
