"""Placing one more image in a finished model from 2D-3D matches."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from aomgen.core.camera import Camera
from aomgen.core.transforms import invert, rotvec_from_matrix
from aomgen.core.values import Array

MIN_INLIERS = 30
MAX_ERROR_PX = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Links:
    """Pixels (M, 2) of an image and the points (M, 3) they show, with outliers."""

    pixels: Array
    points_recon: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Resection:
    """A placed camera.

    Attributes:
        camera_recon: Optics and pose.
        inliers: Matches that fit.
        depth: Median depth of these, recon units.
    """

    camera_recon: Camera
    inliers: int
    depth: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """How far two placements are apart; `distance_share` is relative to the scene's depth."""

    angle_deg: float
    distance_share: float


def resect(
    links: Links, intrinsics: tuple[float, float, float, float] | None, size: tuple[int, int], seed: int
) -> Resection | None:
    """Camera from matches, or None when fewer than `MIN_INLIERS` agree on one.

    Args:
        links: Matches with outliers.
        intrinsics: [fx, fy, cx, cy] in px; None estimates the focal length.
        size: Width and height, [px].
        seed: Of RANSAC.

    Source: P3P in LO-RANSAC, then robust refinement, as in COLMAP.
    """
    width, height = size
    if intrinsics is None:
        guess = [1.2 * max(size), width / 2, height / 2]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=guess)
    else:
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=list(intrinsics))
    if len(links.pixels) < MIN_INLIERS:
        return None
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=intrinsics is None)
    estimation.ransac.max_error = MAX_ERROR_PX
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=intrinsics is None)
    found = pycolmap.estimate_and_refine_absolute_pose(
        links.pixels, links.points_recon, camera, estimation, refinement
    )
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    T_cam_recon = np.eye(4)
    T_cam_recon[:3] = found["cam_from_world"].matrix()
    K = camera.calibration_matrix()
    placed = Camera(
        fx=K[0, 0],
        fy=K[1, 1],
        cx=K[0, 2],
        cy=K[1, 2],
        width=width,
        height=height,
        T_world_cam=invert(T_cam_recon),
    )
    _, depths = placed.project(links.points_recon[np.asarray(found["inlier_mask"], bool)])
    return Resection(camera_recon=placed, inliers=int(found["num_inliers"]), depth=float(np.median(depths)))


def agree(a: Resection, b: Resection) -> Difference:
    """Rotation and relative distance between two placements of the same camera."""
    turn = rotvec_from_matrix(a.camera_recon.T_world_cam[:3, :3].T @ b.camera_recon.T_world_cam[:3, :3])
    distance = np.linalg.norm(a.camera_recon.center - b.camera_recon.center)
    return Difference(
        angle_deg=float(np.degrees(np.linalg.norm(turn))),
        distance_share=float(distance / min(a.depth, b.depth)),
    )
