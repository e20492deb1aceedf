"""Placing one more image in a finished model from 2D-3D matches."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.transforms import invert, rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.reconstruction.cameras.lens_choice import LensChoice, compare
from aomgen.reconstruction.cameras.mapped import lens_of, opencv_params

MIN_INLIERS = 30
MAX_ERROR_PX = 6.0
FOLDS = 5
LENS_ROUNDS = 3
# A camera with the scan's image size has the scan's lens, until its own predicts matches better by
# this many standard errors. Measured: -4 to 2 where it is the same lens, from 4 up where the focal
# length differs by a hundredth.
OWN_LENS_SIGNIFICANCE = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Links:
    """Pixels (M, 2) of an image, as photographed, and the points (M, 3) they show, with outliers."""

    pixels: Array
    points_recon: Array

    def with_links(self, other: "Links") -> "Links":
        """Both: two stills of one camera."""
        return Links(
            pixels=np.concatenate([self.pixels, other.pixels]),
            points_recon=np.concatenate([self.points_recon, other.points_recon]),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Resection:
    """A placed camera.

    Attributes:
        camera_recon: Optics of the straightened image, and pose.
        inliers: Which matches (M,) fit.
        depth: Median depth of these, recon units.
        spread: Extent of these in the image: the smaller of width and height between the 5th and
            95th percentile, as a share of the image's.
    """

    camera_recon: Camera
    inliers: NDArray[np.bool_]
    depth: float
    spread: float

    @property
    def count(self) -> int:
        """Number of matches that fit."""
        return int(self.inliers.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """How far two placements are apart; `distance_share` is relative to the scene's depth."""

    angle_deg: float
    distance_share: float


def resect(links: Links, lens: Lens, *, focal_known: bool, seed: int) -> Resection | None:
    """Camera from matches, or None when fewer than `MIN_INLIERS` agree on one.

    Args:
        links: Matches with outliers.
        lens: Optics; only its distortion and image size count when the focal length is unknown.
        focal_known: Whether to keep the focal length.
        seed: Of RANSAC.

    Source: P3P in LO-RANSAC, then robust refinement, as in COLMAP.
    """
    if len(links.pixels) < MIN_INLIERS:
        return None
    straight = lens.straight()
    size = {"width": lens.width, "height": lens.height}
    if focal_known:
        params = [straight.fx, straight.fy, straight.cx, straight.cy]
        camera = pycolmap.Camera(model="PINHOLE", params=params, **size)
    else:
        params = [straight.fx, straight.cx, straight.cy]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", params=params, **size)
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=not focal_known)
    estimation.ransac.max_error = MAX_ERROR_PX
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=not focal_known)
    pixels = lens.straightened(links.pixels)
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels, links.points_recon, camera, estimation, refinement
    )
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    optics, inliers = lens_of(camera), np.asarray(found["inlier_mask"], bool)
    placed = Camera(
        fx=optics.fx,
        fy=optics.fy,
        cx=optics.cx,
        cy=optics.cy,
        T_world_cam=_T_recon_cam(found["cam_from_world"]),
        **size,
    )
    low, high = np.percentile(pixels[inliers], [5, 95], axis=0)
    return Resection(
        camera_recon=placed,
        inliers=inliers,
        depth=float(np.median(placed.project(links.points_recon[inliers])[1])),
        spread=float(((high - low) / [lens.width, lens.height]).min()),
    )


def agree(a: Resection, b: Resection) -> Difference:
    """Rotation and relative distance between two placements of the same camera."""
    turn = rotvec_from_matrix(a.camera_recon.T_world_cam[:3, :3].T @ b.camera_recon.T_world_cam[:3, :3])
    distance = np.linalg.norm(a.camera_recon.center - b.camera_recon.center)
    return Difference(
        angle_deg=float(np.degrees(np.linalg.norm(turn))),
        distance_share=float(distance / min(a.depth, b.depth)),
    )


def choose_view_lens(links: Links, placed: Resection, *, focal_known: bool, seed: int) -> LensChoice:
    """Compare pinhole and distortion on one view that was placed as a pinhole.

    The matches are told inliers under the lens itself, because a pinhole drops those near the
    border; then every match is predicted by a fit to the other folds.
    """
    start = placed.camera_recon
    plain = Lens(fx=start.fx, fy=start.fy, cx=start.cx, cy=start.cy, width=start.width, height=start.height)
    inliers, lens = placed.inliers, plain
    for _ in range(LENS_ROUNDS):
        lens, T_recon_cam = _refined(links, inliers, plain, start, (focal_known, True))
        inliers = _squared(links, lens, T_recon_cam) <= MAX_ERROR_PX**2
    rows = np.random.default_rng(seed).permutation(np.flatnonzero(inliers))
    errors: dict[bool, list[Array]] = {False: [], True: []}
    for fold in np.array_split(rows, FOLDS):
        others = inliers.copy()
        others[fold] = False
        for bends, found in errors.items():
            fit = _refined(links, others, plain, start, (focal_known, bends))
            found += [error[None] for error in _squared(links, *fit)[fold]]
    gain, significance = compare(errors[False], errors[True])
    return LensChoice(lens=lens, gain=gain, significance=significance)


def own_lens_significance(links: Links, placed: Resection, lenses: tuple[Lens, Lens], *, seed: int) -> float:
    """How much better a camera's own focal length predicts matches than a given lens, in standard errors.

    Args:
        links: Matches.
        placed: The camera as it was placed with its own focal length.
        lenses: The given lens, kept as it is, and its own, of which the focal length is refined.
        seed: Of the folds.
    """
    given, own = lenses
    rows = np.random.default_rng(seed).permutation(np.flatnonzero(placed.inliers))
    errors: tuple[list[Array], list[Array]] = ([], [])
    for fold in np.array_split(rows, FOLDS):
        others = placed.inliers.copy()
        others[fold] = False
        fits = (
            _refined(links, others, given, placed.camera_recon, (True, False)),
            _refined(links, others, own, placed.camera_recon, (False, own.bends)),
        )
        for found, fit in zip(errors, fits, strict=True):
            found += [error[None] for error in _squared(links, *fit)[fold]]
    return compare(*errors)[1]


def _refined(
    links: Links, use: NDArray[np.bool_], lens: Lens, start: Camera, choice: tuple[bool, bool]
) -> tuple[Lens, Array]:
    """Lens and pose (4, 4) fitted to some matches; `choice` = (focal length known, distortion)."""
    focal_known, bends = choice
    camera = pycolmap.Camera(model="OPENCV", width=lens.width, height=lens.height, params=opencv_params(lens))
    refinement = pycolmap.AbsolutePoseRefinementOptions(
        refine_focal_length=not focal_known, refine_extra_params=bends, gradient_tolerance=1e-3
    )
    T_cam_recon = start.T_cam_world
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(T_cam_recon[:3]), links.pixels, links.points_recon, use, camera, refinement
    )
    if found is None:
        return lens, start.T_world_cam
    return lens_of(camera), _T_recon_cam(found["cam_from_world"])


def _squared(links: Links, lens: Lens, T_recon_cam: Array) -> Array:
    points_cam = (links.points_recon - T_recon_cam[:3, 3]) @ T_recon_cam[:3, :3]
    depths = np.where(np.abs(points_cam[:, 2:]) < 1e-9, 1e-9, points_cam[:, 2:])
    errors = ((lens.pixels(points_cam[:, :2] / depths) - links.pixels) ** 2).sum(1)
    return np.where(depths[:, 0] > 0, errors, np.inf)


def _T_recon_cam(cam_from_recon: pycolmap.Rigid3d) -> Array:
    T_cam_recon = np.eye(4)
    T_cam_recon[:3] = cam_from_recon.matrix()
    return invert(T_cam_recon)
