"""A mapper's model as plain values, in undistorted pixels."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from aomgen.core.lens import Lens
from aomgen.core.transforms import invert
from aomgen.core.values import Array

# Refined parameters of a lens: none (the lens is stated, or that of the scan); the focal length; also one radial coefficient;
# also all four coefficients.
LensModel = Literal["stated", "scan", "focal", "radial", "full"]

# Standard deviation of a SIFT feature, [px]; matches with larger errors (mismatches, shadows, blurred images) have less weight.
FEATURE_SD_PX = 0.5
# Largest number of iterations of bundle adjustment, which starts near the optimum, from a mapped model.
MAX_ITERATIONS = 30


@dataclass(frozen=True, kw_only=True)
class SparseModel:
    """Camera poses (4, 4) by image name and P points of a mapped scan, and its mean reprojection error.

    Attributes:
        lens: The scan camera's optics; its undistorted images have `K`.
        observations: (point index, image name).
        point_of_feature: For each image, point index of each feature (F,), -1 = none.
    """

    Ts_recon_cam: dict[str, Array]
    lens: Lens
    points_recon: Array
    colors_srgb: NDArray[np.uint8]
    observations: list[tuple[int, str]]
    point_of_feature: dict[str, NDArray[np.int64]]
    error_px: float

    @property
    def K(self) -> Array:
        """Intrinsics (3, 3) of the undistorted scan images, [px]."""
        return self.lens.pinhole_camera(np.eye(4)).K


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Verified matches of images a and b: pixels (M, 2) in each."""

    a: str
    b: str
    pixels_a: Array
    pixels_b: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Links:
    """Pixels (M, 2) of an image, as photographed, and the points (M, 3) they show, with outliers."""

    pixels: Array
    points_recon: Array


def read_model(model: pycolmap.Reconstruction, names: dict[str, str]) -> SparseModel:
    """Convert a model of one camera to values; `names` gives the image name of each file."""
    rows = {point_id: row for row, point_id in enumerate(sorted(model.points3D))}
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    poses, features, observations = {}, {}, []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        name = names[image.name]
        poses[name] = T_recon_cam(image.cam_from_world())
        point_of = [rows[p.point3D_id] if p.has_point3D() else -1 for p in image.points2D]
        features[name] = np.array(point_of, np.int64)
        observations += [(row, name) for row in sorted({row for row in point_of if row >= 0})]
    return SparseModel(
        Ts_recon_cam=poses,
        lens=lens_of(next(iter(model.cameras.values()))),
        points_recon=np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        colors_srgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        observations=observations,
        point_of_feature=features,
        error_px=float(model.compute_mean_reprojection_error()),
    )


def T_recon_cam(cam_from_recon: pycolmap.Rigid3d) -> Array:
    """Return the pose (4, 4) of a registered camera."""
    T_cam_recon = np.eye(4)
    T_cam_recon[:3] = cam_from_recon.matrix()
    return invert(T_cam_recon)


def adjust(
    model: pycolmap.Reconstruction,
    *,
    focal: bool = False,
    distortion: bool = False,
    points_only: bool = False,
) -> None:
    """Adjust a whole model in place by robust bundle adjustment, because COLMAP's own function permanently enables its log.

    Args:
        focal, distortion: Refine these.
        points_only: Keep the poses.
    """
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = focal
    options.refine_extra_params = distortion
    options.refine_rig_from_world = not points_only
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = FEATURE_SD_PX
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def camera_lens(model: pycolmap.Reconstruction) -> Lens:
    """Return the optics of a model of one camera."""
    return lens_of(next(iter(model.cameras.values())))


def set_lens(model: pycolmap.Reconstruction, lens: Lens) -> None:
    """Give a model's cameras a lens."""
    for camera in model.cameras.values():
        set_camera(camera, lens)


def set_camera(camera: pycolmap.Camera, lens: Lens) -> None:
    """Give a camera a lens, as a pinhole where it does not bend."""
    name = pycolmap.CameraModelId.OPENCV if lens.bends else pycolmap.CameraModelId.PINHOLE
    camera.model, camera.params = name, opencv_params(lens)[: 8 if lens.bends else 4]


def free_lens(camera: pycolmap.Camera, kind: LensModel) -> None:
    """Switch a camera to the parameters of a lens model; coefficients that the model lacks are dropped."""
    lens = lens_of(camera)
    if kind == "radial":
        camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
        camera.params = [(lens.fx + lens.fy) / 2, lens.cx, lens.cy, lens.k1]
    elif kind == "full":
        camera.model, camera.params = pycolmap.CameraModelId.OPENCV, opencv_params(lens)


def lens_of(camera: pycolmap.Camera) -> Lens:
    """Convert a COLMAP camera without distortion, or with one or OpenCV's four coefficients, to optics."""
    K = camera.calibration_matrix()
    bent = [float(camera.params[index]) for index in camera.extra_params_idxs()]
    k1, k2, p1, p2 = (*bent, 0.0, 0.0, 0.0, 0.0)[:4]
    return Lens(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=camera.width,
        height=camera.height,
        k1=k1,
        k2=k2,
        p1=p1,
        p2=p2,
    )


def opencv_params(lens: Lens) -> list[float]:
    """Convert optics to the parameters of COLMAP's OPENCV camera."""
    return [lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2, lens.p1, lens.p2]
