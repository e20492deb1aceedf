"""The paper's alignment: robot points of the scan moved onto points of the posed model by rigid ICP.

It serves as a comparison for the outlines of `alignment`. The paper assumes that the robot's points are segmented and that the scan
is in meters. Here the points are those in all prompted boxes above the support, and heading and size are those of the starting
poses of `align`, because a rigid motion cannot correct the size later.
"""

import numpy as np
from scipy.spatial import cKDTree

from aomgen.alignment.align import unit_frame
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.pose_search import Scan, search_poses
from aomgen.alignment.starting_poses import RobotBox, up_candidates
from aomgen.core.alignment import Alignment
from aomgen.core.boxes import fit_plane
from aomgen.core.gaussians import Gaussians
from aomgen.core.mesh import face_normals_areas
from aomgen.core.transforms import apply, rotvec_from_matrix, transform
from aomgen.core.values import Array
from aomgen.errors import AlignmentError
from aomgen.robots.robot import RobotConfiguration

STAGE = "alignment (paper)"
# Numbers of points sampled on the robot model, and of the scan; those on the model are denser.
_MODEL_POINTS, _SCAN_POINTS = 12_000, 2_000
# Least color score of a starting pose, as a share of the best one; the pose with the best match after ICP is used.
_START_SHARE = 0.5
# Least opacity of a Gaussian on a surface.
_SOLID = 0.3
# Triples tried in the search for supports: sufficient to find a plane with a quarter of the points almost surely.
_PLANE_TRIALS = 500
# Least number of robot points of a usable scan.
_MIN_POINTS = 200
# Least share of the robot points on the model after ICP.
MIN_MATCHED = 0.3
# Largest number of closest-point steps at one kernel width; they end earlier if the motion is small.
_STEPS = 40
# Motion of a step at which the iteration ends; smaller ones do not change the reported values.
_SETTLED_M, _SETTLED_RAD = 1e-5, 1e-5


def align_as_paper(
    views: list[AlignmentImage],
    boxes: list[RobotBox],
    gaussians_recon: Gaussians,
    configuration: RobotConfiguration,
    rng: np.random.Generator,
    min_matched: float = MIN_MATCHED,
) -> Alignment:
    """Estimate `S_world_recon` by rigid ICP; `support` is the share of robot points that lie on the model.

    Outlines are not used, so `residual_px` is 0 and the support by chance is unknown; `ee_sd_m` is the root mean square distance
    of the points from the model.

    Args:
        views: Scan images, used for the starting poses only.
        boxes: Prompted boxes around the robot, two or more.
        min_matched: Least share of the robot points on the model after ICP.

    Raises:
        AlignmentError: Too few boxes or robot points, or too few of them match the model.

    Source: AOMGen, sec. 4.1, "Scene and robot alignment". Not checked: the scale.
    """
    if not len(boxes) >= 2:
        raise AlignmentError(
            STAGE, f"{len(boxes)} prompts give a box around the robot, expected 2", "add a robot box"
        )
    S_unit_recon = unit_frame([view.camera_recon.center for view in views], views[0].camera_recon.T_world_cam)
    solid = gaussians_recon.opacities > _SOLID
    scan = Scan(
        views=views, boxes=boxes, points_recon=np.asarray(gaussians_recon.means[solid], np.float64)
    ).view_from(S_unit_recon)
    up = up_candidates([view.camera_recon for view in scan.views], scan.points_recon, rng)[0]
    points = robot_points(scan.points_recon, scan.boxes, up, rng)
    model = configuration.surface_world(_MODEL_POINTS, rng)
    # The distance between samples on the model is about this value.
    meshes = configuration.robot.meshes
    area = sum(face_normals_areas(mesh.vertices_body, mesh.faces)[1].sum() for mesh in meshes)
    spacing_m = float(np.sqrt(area / _MODEL_POINTS))
    fits = []
    for S in _starts(scan, configuration, rng):
        source = apply(S, points)
        T = rigid_icp(source, model, spacing_m)
        fits.append((*measure_match(apply(T, source), model, spacing_m), T @ S))
    fits.sort(key=lambda item: -item[0])
    matched, rms_m, S = fits[0]
    if not matched >= min_matched:
        raise AlignmentError(
            STAGE,
            f"{matched:.0%} of {len(points)} robot points lie on the model, expected {min_matched:.0%}",
            "draw tighter robot boxes from other sides, or use alignment_method = 'outlines'",
        )
    return Alignment(
        S_world_recon=S @ S_unit_recon,
        support=matched,
        chance=0.0,
        runner_up_support=fits[1][0] if len(fits) > 1 else 0.0,
        residual_px=0.0,
        residual_px_of_view={},
        ee_sd_m=rms_m,
    )


def robot_points(
    surface_recon: Array,
    boxes: list[RobotBox],
    up_recon: Array,
    rng: np.random.Generator,
) -> Array:
    """Select points (N, 3) of the surface that all boxes show and that belong to no level support, thinned evenly.

    Raises:
        AlignmentError: There are too few points.
    """
    inside = np.ones(len(surface_recon), bool)
    for box in boxes:
        pixels, depths = box.camera_recon.project(surface_recon)
        inside &= (depths > 0) & np.all((pixels >= box.box_px[:2]) & (pixels <= box.box_px[2:]), axis=1)
    found = surface_recon[inside]
    for _ in range(2):
        found = _without_support(found, up_recon, rng)
    if not len(found) >= _MIN_POINTS:
        raise AlignmentError(
            STAGE,
            f"{len(found)} Gaussians lie in all robot boxes, expected {_MIN_POINTS}",
            "check the boxes",
        )
    found = _thin(found, 0.02 * _spread(found))
    return found[rng.permutation(len(found))[:_SCAN_POINTS]]


def _spread(points: Array) -> float:
    """Compute the median distance from the center, which is robust to a few outliers."""
    return float(np.median(np.linalg.norm(points - np.median(points, 0), axis=1)))


def _thin(points: Array, cell: float) -> Array:
    """Average the points of every cell that contains points."""
    cells = np.unique(np.floor(points / max(cell, 1e-12)).astype(np.int64), axis=0, return_inverse=True)[
        1
    ].ravel()
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, points[:, axis]) / counts for axis in range(3)], 1)


def _without_support(points: Array, up: Array, rng: np.random.Generator) -> Array:
    """Remove the level plane with the most points if it contains at least a tenth of them."""
    tolerance = 0.03 * _spread(points) if len(points) else 0.0
    # The planes are level within 15 degrees; others may belong to the arm.
    plane = (
        fit_plane(points, tolerance, rng, _PLANE_TRIALS, axis=up, max_tilt_deg=15.0) if len(points) else None
    )
    if plane is None:
        return points
    heights = np.abs((points - plane[1]) @ plane[0])
    return points[heights > 2 * tolerance] if np.mean(heights < tolerance) >= 0.1 else points


def _starts(scan: Scan, configuration: RobotConfiguration, rng: np.random.Generator) -> Array:
    """List similarities (H, 4, 4) that the colors support, best first, as `align` does."""
    Ss, scores = search_poses(scan, configuration, rng)
    return Ss[scores >= _START_SHARE * scores.max()]


def rigid_icp(source: Array, target: Array, kernel_m: float) -> Array:
    """Estimate the rigid motion (4, 4) of the source onto the target; each point is matched to the nearest one.

    Args:
        source: Points (N, 3), [m].
        target: Points (M, 3), [m], denser than `kernel_m`.
        kernel_m: Final width of the kernel; distances much larger than this have no weight.

    Source: Zhang, Yao and Deng, "Fast and Robust Iterative Closest Point", PAMI 2021 (Welsch's
    function, its width halved from coarse to fine; without their acceleration). Not checked: whether
    the iteration converges to the correct one of several minima.
    """
    tree = cKDTree(target)
    T, distances = np.eye(4), tree.query(source)[0]
    width = max(3 * float(np.median(distances)), kernel_m)
    while True:
        for _ in range(_STEPS):
            moved = apply(T, source)
            distances, nearest = tree.query(moved)
            step = fit_weighted_rigid(moved, target[nearest], np.exp(-0.5 * (distances / width) ** 2))
            T = step @ T
            turn = np.linalg.norm(rotvec_from_matrix(step[:3, :3]))
            shift = np.linalg.norm(apply(step, moved.mean(0)) - moved.mean(0))
            if shift < _SETTLED_M and turn < _SETTLED_RAD:
                break
        if width <= kernel_m:
            break
        width = max(width / 2, kernel_m)
    return T


def measure_match(points: Array, target: Array, kernel_m: float) -> tuple[float, float]:
    """Compute the share of points (N, 3) within the kernel of the target, and their RMS distance, [m]; infinite without any."""
    distances = cKDTree(target).query(points)[0]
    near = distances < 2 * kernel_m
    return float(near.mean()), float(np.sqrt(np.mean(distances[near] ** 2))) if near.any() else float("inf")


def fit_weighted_rigid(source: Array, target: Array, weights: Array) -> Array:
    """Fit the rigid motion (4, 4) between corresponding points (N, 3) by weighted least squares.

    Source: Kabsch, 1976. If all weights (N,) are zero, the result is the identity.
    """
    total = float(weights.sum())
    if not total > 1e-12:
        return np.eye(4)
    share = weights / total
    middle_source, middle_target = share @ source, share @ target
    covariance = (target - middle_target).T @ (share[:, None] * (source - middle_source))
    U, _, Vt = np.linalg.svd(covariance)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ mirror @ Vt
    return transform(R, middle_target - R @ middle_source)
