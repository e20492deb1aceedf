"""Fixed cameras in the scan's model: placed twice from 2D-3D matches, by the first frame and by the median."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import Intrinsics
from aomgen.core.structure import Figures
from aomgen.core.transforms import rotvec_from_matrix
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.structure.lens_choice import MIN_SIGNIFICANCE, LensChoice, climb, compare, lean_on_stated
from aomgen.structure.mapping import Workspace
from aomgen.structure.sparse_model import (
    LensModel,
    Links,
    SparseModel,
    T_recon_cam,
    free_lens,
    lens_of,
    set_camera,
)

STILLS = ("first", "median")
# Largest rotation between two estimates of one pose, [deg]. Two correct estimates differ by 0.01 to 0.1 degrees and 0.1 % of the
# depth; a wrong one differs by far more than the limit.
SAME_ANGLE_DEG = 2.0
# Largest distance between two estimates of one pose, as a share of the depth.
SAME_DISTANCE_SHARE = 0.03
# The better one of two contradicting poses is accepted if it has this many times the matches of the other.
CLEAR_MAJORITY = 2.0
# Least extent of the matches: matches in one corner of the image do not determine the rotation about them.
MIN_SPREAD = 0.15
# Least number of inliers of a camera: twice the number that COLMAP requires for a pair, because only one view determines it.
MIN_INLIERS = 30
# Largest reprojection error of an inlier, [px]: it includes the distortion of a lens that is not yet estimated.
MAX_ERROR_PX = 6.0
# Folds of the jackknife over matches.
FOLDS = 5
# Alternations of inlier selection and lens estimation.
LENS_ROUNDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoView:
    """Images of a fixed camera: its first frame and the temporal median of its video.

    Attributes:
        first_srgb: (H, W, 3) uint8, robot as in the scan.
        median_srgb: (H, W, 3) uint8, mostly without the moving arm.
    """

    first_srgb: NDArray[np.uint8]
    median_srgb: NDArray[np.uint8]
    intrinsics: Intrinsics | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Resection:
    """A registered camera.

    Attributes:
        camera_recon: Optics of the undistorted image, and pose.
        inliers: Mask (M,) of the matches that fit.
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


def place_fixed_camera(
    work: Workspace, mapped: SparseModel, name: str, view: DemoView, scan_intrinsics: Intrinsics | None
) -> tuple[Camera, Lens, Figures]:
    """Find a fixed camera and its lens.

    The scan's lens is also tried if the image sizes are equal and the view states no intrinsics or those of the scan.

    Returns:
        Optics of the undistorted frames and pose, recon frame; the lens; and metrics of the registration with the name of
        the used still image (JSON values).

    Raises:
        ReconstructionError: Neither still can be registered, or they contradict each other and neither is clearly better.
    """
    group = f"demo:{name}"
    stated, lens = view.intrinsics, work.lens(group)
    focal_known = stated is not None
    found = _to_fixed_camera(work, mapped, group, lens, focal_known=focal_known)
    figures: Figures = {}
    if found:
        still, best = max(found.items(), key=lambda item: item[1].count)
        same = (lens.width, lens.height) == (mapped.lens.width, mapped.lens.height)
        scan_lens = mapped.lens if same and stated in (None, scan_intrinsics) else None
        links = work.links(group, (still,), mapped)
        choice = choose_view_lens(links, best, stated, scan_lens, seed=work.seed)
        figures |= {"lens": choice.model, "lens_gain": choice.gain, "lens_significance": choice.significance}
        lens, focal_known = choice.lens, True
        work.set_lens(group, lens)
        found = _to_fixed_camera(work, mapped, group, lens, focal_known=True)
    used, reason = _choose(name, found)
    best = found[used[0]]
    if len(used) == 2:
        best = resect(work.links(group, used, mapped), lens, focal_known=focal_known, seed=work.seed) or best
    figures |= {f"{still}_inliers": placed.count for still, placed in found.items()}
    figures |= {"used": list(used), "reason": reason}
    if len(found) == 2:
        angle_deg, share = difference(found["first"], found["median"])
        figures |= {"disagreement_deg": angle_deg, "disagreement_share": share}
    return best.camera_recon, lens, figures


def _to_fixed_camera(
    work: Workspace, mapped: SparseModel, group: str, lens: Lens, *, focal_known: bool
) -> dict[str, Resection]:
    found = {
        still: resect(work.links(group, (still,), mapped), lens, focal_known=focal_known, seed=work.seed)
        for still in STILLS
    }
    return {still: placed for still, placed in found.items() if placed is not None}


def _choose(name: str, found: dict[str, Resection]) -> tuple[tuple[str, ...], str]:
    """Choose the stills to use, with the reason.

    Raises:
        ReconstructionError: None can be used.
    """
    where = f"demo camera {name!r}"
    remedy = "scan from nearby this camera, so that its view is covered"
    held = {still: placed for still, placed in found.items() if placed.spread >= MIN_SPREAD}
    if not held:
        problem = (
            f"is placed only by matches in {max(p.spread for p in found.values()):.0%} of its image, "
            f"at least {MIN_SPREAD:.0%} are needed"
            if found
            else "cannot be placed in the scan's model, neither by its first frame nor by its temporal median"
        )
        raise ReconstructionError(where, problem, remedy)
    if len(held) == 1:
        return tuple(held), "the other still could not be placed"
    first, median = held["first"], held["median"]
    angle_deg, share = difference(first, median)
    if angle_deg <= SAME_ANGLE_DEG and share <= SAME_DISTANCE_SHARE:
        return STILLS, "first frame and temporal median agree"
    more, fewer = ("first", "median") if first.count >= median.count else ("median", "first")
    if not held[more].count >= CLEAR_MAJORITY * held[fewer].count:
        raise ReconstructionError(
            where,
            f"its poses from the first frame and from the temporal median are {angle_deg:.1f} deg and "
            f"{share:.0%} of its distance apart, with {first.count} and {median.count} "
            "matches, so neither is reliable",
            f"check that the camera did not move; {remedy}",
        )
    return (more,), f"they disagree, and it has {held[more].count} matches against {held[fewer].count}"


def resect(links: Links, lens: Lens, *, focal_known: bool, seed: int) -> Resection | None:
    """Estimate a camera from matches; None if fewer than `MIN_INLIERS` are consistent with one.

    Args:
        lens: Optics; if the focal length is unknown, only its distortion and image size are used.

    Source: P3P in LO-RANSAC, then robust refinement, as in COLMAP.
    """
    if len(links.pixels) < MIN_INLIERS:
        return None
    straight = lens.straight()
    focals = [straight.fx, straight.fy] if focal_known else [straight.fx]
    camera = pycolmap.Camera(
        model="PINHOLE" if focal_known else "SIMPLE_PINHOLE",
        params=[*focals, straight.cx, straight.cy],
        width=lens.width,
        height=lens.height,
    )
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=not focal_known)
    estimation.ransac.max_error = MAX_ERROR_PX
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=not focal_known)
    pixels = lens.undistort(links.pixels)
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels, links.points_recon, camera, estimation, refinement
    )
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    inliers = np.asarray(found["inlier_mask"], bool)
    placed = lens_of(camera).pinhole_camera(T_recon_cam(found["cam_from_world"]))
    low, high = np.percentile(pixels[inliers], [5, 95], axis=0)
    return Resection(
        camera_recon=placed,
        inliers=inliers,
        depth=float(np.median(placed.project(links.points_recon[inliers])[1])),
        spread=float(((high - low) / [lens.width, lens.height]).min()),
    )


def difference(a: Resection, b: Resection) -> tuple[float, float]:
    """Compute the rotation [deg] between two estimates of a camera, and their distance as a share of the scene's depth."""
    turn = rotvec_from_matrix(a.camera_recon.T_world_cam[:3, :3].T @ b.camera_recon.T_world_cam[:3, :3])
    distance = np.linalg.norm(a.camera_recon.center - b.camera_recon.center)
    return float(np.degrees(np.linalg.norm(turn))), float(distance / min(a.depth, b.depth))


def choose_view_lens(
    links: Links, placed: Resection, stated: Intrinsics | None, scan_lens: Lens | None, *, seed: int
) -> LensChoice:
    """Choose the lens model of one view by held-out matches.

    Args:
        placed: The registered camera, with the stated optics if there are any.
        scan_lens: Lens of the scan if the view may have the same; another lens has to be clearly better.

    Inliers are determined with the richest lens model, because a pinhole model rejects those near the border.
    """
    start = placed.camera_recon
    plain = _plain_lens(stated, start)
    inliers = placed.inliers
    for _ in range(LENS_ROUNDS):
        inliers = (
            _compute_squared_errors(links, *_refine_camera(links, inliers, plain, start, "full"))
            <= MAX_ERROR_PX**2
        )
    rows = np.random.default_rng(seed).permutation(np.flatnonzero(inliers))
    folds = [np.isin(np.arange(len(inliers)), rows[k::FOLDS]) for k in range(FOLDS)]
    fits: dict[LensModel, list[tuple[Lens, Array]]] = {}

    def held_out_errors(kind: LensModel) -> list[Array]:
        lens = scan_lens if kind == "scan" and scan_lens is not None else plain
        if kind not in fits:
            fits[kind] = [_refine_camera(links, inliers & ~fold, lens, start, kind) for fold in folds]
        return [
            error[None]
            for fold, fit in zip(folds, fits[kind], strict=True)
            for error in _compute_squared_errors(links, *fit)[fold]
        ]

    chosen, gain, significance = climb(held_out_errors, stated)
    if scan_lens is not None:
        gain, significance = compare(held_out_errors("scan"), held_out_errors(chosen))
        if significance < MIN_SIGNIFICANCE:
            return LensChoice(lens=scan_lens, model="scan", gain=gain, significance=significance)
    lens, _ = _refine_camera(links, inliers, plain, start, chosen)
    if stated is not None and chosen != "stated":
        focals = np.log([fit.fx for fit, _ in fits[chosen]])
        lens = lean_on_stated(lens, stated, float(np.sqrt((FOLDS - 1) * focals.var())))
        lens, _ = _refine_camera(links, inliers, lens, start, chosen, focal=False)
    return LensChoice(lens=lens, model=chosen, gain=gain, significance=significance)


def _plain_lens(stated: Intrinsics | None, camera: Camera) -> Lens:
    """Return the stated optics if they include a distortion, else the pinhole optics of a camera."""
    if stated is None or stated.distortion is None:
        stated = Intrinsics(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
    return stated.lens(camera.width, camera.height)


def _refine_camera(
    links: Links, use: NDArray[np.bool_], lens: Lens, start: Camera, kind: LensModel, *, focal: bool = True
) -> tuple[Lens, Array]:
    """Fit the lens and the pose (4, 4) of a camera to the selected matches; `focal` frees the focal length."""
    camera = pycolmap.Camera(model="PINHOLE", width=lens.width, height=lens.height, params=[1.0] * 4)
    set_camera(camera, lens)
    free_lens(camera, kind)
    fixed = kind in ("stated", "scan")
    refinement = pycolmap.AbsolutePoseRefinementOptions(
        refine_focal_length=focal and not fixed,
        refine_extra_params=kind in ("radial", "full"),
        gradient_tolerance=1e-3,
    )
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(start.T_cam_world[:3]), links.pixels, links.points_recon, use, camera, refinement
    )
    if found is None:
        return lens, start.T_world_cam
    return lens_of(camera), T_recon_cam(found["cam_from_world"])


def _compute_squared_errors(links: Links, lens: Lens, T: Array) -> Array:
    points_cam = (links.points_recon - T[:3, 3]) @ T[:3, :3]
    depths = np.where(np.abs(points_cam[:, 2:]) < 1e-9, 1e-9, points_cam[:, 2:])
    errors = ((lens.pixels(points_cam[:, :2] / depths) - links.pixels) ** 2).sum(1)
    return np.where(depths[:, 0] > 0, errors, np.inf)
