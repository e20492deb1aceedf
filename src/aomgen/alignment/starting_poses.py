"""Starting poses of the robot from gravity and its prompted boxes: many guesses, each fitted to the boxes.

Two complete boxes determine the pose for a given heading; a single box does not determine the depth, and a box that the image
border cuts determines less. Undetermined quantities keep their initial guess.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.core.boxes import fit_plane
from aomgen.core.camera import Camera
from aomgen.core.least_squares import Kernel
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity
from aomgen.core.values import Array, freeze_arrays

# Distance to the image border within which it cuts the side of a box, [px]: the accuracy of a hand-drawn box.
BORDER_PX = 3.0
# Error of a side of a manually drawn box, as a share of the box; larger gaps have less weight.
_SIDE_ERROR = 0.1
# Prior of a guess (translation and log scale): relative standard deviations, and its weight in units of the weight of a box side.
_GUESS_SPREAD, _GUESS_WEIGHT = np.array([1.0, 1.0, 1.0, 0.5]), 0.02
# Gauss-Newton steps of a starting pose; it is refined on contours later.
_STEPS = 12
# Triples tried in the search for a level plane: sufficient to find one that contains a tenth of the points almost surely.
_PLANE_TRIALS = 1500
# Plane normals that are tried before the mean of the cameras: table and floor.
_PLANES = 2
# Directions in which the farthest points of the robot are kept, and random points in addition.
_EXTREME_POINTS = 150


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotBox:
    """A box around the robot in one scan image.

    Attributes:
        box_px: x0, y0, x1, y1 (4,), [px]; the robot may extend beyond a side on the image border.
    """

    camera_recon: Camera
    box_px: Annotated[Array, "4"]

    __post_init__ = freeze_arrays


def find_starting_poses(
    boxes: list[RobotBox],
    vertices_world: Array,
    ups_recon: list[Array],
    points_recon: Array,
    rng: np.random.Generator,
    count: int,
) -> tuple[Array, Array]:
    """Guess heading, depth and size, then move and scale each guess until it fills the boxes.

    Except for the first few guesses, the boxes are perturbed for each guess by the error of manually drawn boxes.

    Args:
        vertices_world: Points on the posed robot (V, 3), [m].
        ups_recon: Candidates (3,) for world z in the recon frame, best first.
        points_recon: Sparse points (P, 3); those seen in a box give likely depths.

    Returns:
        Poses `S_world_recon` (H, 4, 4) and their scores (H,): minus the root mean square gap between box sides and
        the robot's extent, as a share of the box's size.

    Source: own; the projected convex hull of the robot touches all sides of its box.
    """
    middle = (vertices_world.min(0) + vertices_world.max(0)) / 2
    hull = _outline_points(vertices_world - middle, rng)
    Rs_world_recon = _headings(ups_recon, rng, count)
    turned = hull @ Rs_world_recon
    center, depth, size = _guesses(boxes, points_recon, float(np.ptp(hull, axis=0).max()), rng, count)
    sides = [_perturb_box(box, rng, count) for box in boxes]
    cuts = [_maybe_cut(box, rng, count) for box in boxes]

    def measure(x: Array) -> tuple[Array, Array]:
        arms = turned * (size * np.exp(x[:, 3]))[:, None, None]
        points = arms + (center + depth[:, None] * x[:, :3])[:, None]
        found = [_gaps(*item, points, arms, depth) for item in zip(boxes, sides, cuts, strict=True)]
        gaps, J = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
        return gaps, J

    x, prior = np.zeros((count, 4)), (_GUESS_WEIGHT / _GUESS_SPREAD) ** 2
    for _ in range(_STEPS):
        gaps, J = measure(x)
        weights = Kernel(scale=_SIDE_ERROR, power=0.5).weights(gaps)
        A = np.einsum("hk,hki,hkj->hij", weights, J, J) + np.diag(prior)
        b = -np.einsum("hk,hki,hk->hi", weights, J, gaps) - prior * x
        x = x + np.clip(np.linalg.solve(A, b[..., None])[..., 0], -0.3, 0.3)
    gaps, _ = measure(x)
    scales_recon = size * np.exp(x[:, 3])
    places = center + depth[:, None] * x[:, :3]
    # The inverse of p_recon_point = s_recon * R^T (p_world - middle) + p_recon:
    Ss = [
        similarity(1 / s, R, middle - R @ p / s)
        for s, R, p in zip(scales_recon, Rs_world_recon, places, strict=True)
    ]
    return np.array(Ss), -np.sqrt(np.mean(gaps**2, axis=1))


def up_candidates(cameras_recon: list[Camera], points_recon: Array, rng: np.random.Generator) -> list[Array]:
    """Estimate likely up directions (3,) in the recon frame, best first.

    Cameras are usually held upright, so the mean of their up directions is close to the true one. The large planes of the scene
    (table, floor) refine it; planes tilted by more than 30 degrees from it are walls.
    """
    mean_up = -np.mean([camera.T_world_cam[:3, 1] for camera in cameras_recon], 0)
    mean_up /= np.linalg.norm(mean_up)
    ups: list[Array] = []
    left = np.asarray(points_recon, np.float64)
    extent = np.median(np.linalg.norm(left - np.median(left, 0), axis=1)) if len(left) else 1.0
    for _ in range(_PLANES):
        if len(left) < 50:
            break
        tolerance = 0.01 * extent
        plane = fit_plane(left, tolerance, rng, _PLANE_TRIALS, axis=mean_up, max_tilt_deg=30.0)
        if plane is None:
            break
        normal, center = plane
        near = np.abs((left - center) @ normal) < 2 * tolerance
        if near.sum() < 0.03 * len(points_recon):
            break
        if all(normal @ up < np.cos(np.radians(2.0)) for up in ups):
            ups.append(normal)
        left = left[~near]
    return [*ups, mean_up]


def _outline_points(points: Array, rng: np.random.Generator) -> Array:
    """Select the points that are farthest in some direction, which determine the extent of a projection.

    The same number of random points represents the extent of a robot that the image border cuts.
    """
    farthest = np.argmax(points @ rng.normal(size=(3, _EXTREME_POINTS)), axis=0)
    return points[np.unique(np.concatenate([farthest, rng.integers(len(points), size=_EXTREME_POINTS)]))]


def _headings(ups: list[Array], rng: np.random.Generator, count: int) -> Array:
    """Sample rotations (N, 3, 3) world from recon: yaws are spread evenly, and better up directions are more frequent."""
    yaws = 2 * np.pi * ((np.arange(count) * (np.sqrt(5) - 1) / 2) % 1)
    shares = 0.5 ** np.arange(1, len(ups) + 1)
    which = rng.choice(len(ups), count, p=shares / shares.sum())
    uprights = np.array([_upright(up) for up in ups])[which]
    turns = np.array([matrix_from_rotvec([0, 0, yaw]) for yaw in yaws])
    return np.asarray(turns @ uprights, np.float64)


def _upright(up: Array) -> Array:
    """Return a rotation (3, 3) that maps `up` to z."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _guesses(
    boxes: list[RobotBox], points: Array, extent: float, rng: np.random.Generator, count: int
) -> tuple[Array, Array, Array]:
    """Sample robot centers (N, 3) on rays through boxes, their depths (N,), and scales of recon over world (N,)."""
    centers, depths, sizes = np.empty((count, 3)), np.empty(count), np.empty(count)
    for number, box in enumerate(boxes):
        mine = np.arange(number, count, len(boxes))
        camera = box.camera_recon
        pixels, z = camera.project(points)
        low, high = box.box_px[:2], box.box_px[2:]
        front = z > 0
        inside = front & np.all((pixels > low) & (pixels < high), axis=1)
        known = z[inside] if inside.sum() >= 10 else z[front]
        if not len(known):
            known = np.ones(1)
        depth = rng.choice(known, len(mine)) * np.exp(rng.normal(0, 0.25, len(mine)))
        at = low + rng.uniform(0.3, 0.7, (len(mine), 2)) * (high - low)
        rays = np.concatenate(
            [(at - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(mine), 1))], 1
        )
        centers[mine] = apply(camera.T_world_cam, depth[:, None] * rays)
        depths[mine] = depth
        # A box that the border cuts contains only a part of the robot.
        sizes[mine] = depth * np.max((high - low) / [camera.fx, camera.fy]) / extent
        sizes[mine] *= np.exp(rng.uniform(0, 0.5, len(mine)) * _cut(box, 2 * _SIDE_ERROR).any())
    return centers, depths, sizes


def _cut(box: RobotBox, near: float = 0.0) -> NDArray[np.bool_]:
    """Mark the sides (4,) on the image border, or nearer to it than a share of the box's size."""
    x0, y0, x1, y1 = box.box_px
    camera = box.camera_recon
    room = np.array([x0, y0, camera.width - x1, camera.height - y1])
    return np.asarray(room <= np.maximum(BORDER_PX, near * np.tile([x1 - x0, y1 - y0], 2)), bool)


def _maybe_cut(box: RobotBox, rng: np.random.Generator, count: int) -> NDArray[np.bool_]:
    """Sample masks (N, 4) of sides that the border cuts; a side close to the border may be cut as well."""
    return _cut(box) | (_cut(box, 2 * _SIDE_ERROR) & (rng.random((count, 4)) < 0.5))


def _perturb_box(box: RobotBox, rng: np.random.Generator, count: int) -> Array:
    """Perturb the sides (N, 4) of a box by the error of manual drawing; cut sides and a quarter of the boxes are not perturbed."""
    spans = np.tile(box.box_px[2:] - box.box_px[:2], 2)
    noise = rng.uniform(-_SIDE_ERROR, _SIDE_ERROR, (count, 4)) * spans
    noise[::4] = 0
    return np.asarray(box.box_px + np.where(_cut(box), 0.0, noise), np.float64)


def _gaps(
    box: RobotBox, sides: Array, cut: NDArray[np.bool_], points: Array, arms: Array, depth: Array
) -> tuple[Array, Array]:
    """Compute the signed gaps (H, 4) between box sides (H, 4) and projected extent, and their Jacobian (H, 4, 4)."""
    camera = box.camera_recon
    R = camera.T_cam_world[:3, :3]
    points_cam = apply(camera.T_cam_world, points)
    near = 0.05 * np.abs(points_cam[..., 2]).mean(1, keepdims=True) + 1e-6
    z = np.maximum(points_cam[..., 2], near)
    pixels = np.stack(
        [
            camera.fx * points_cam[..., 0] / z + camera.cx,
            camera.fy * points_cam[..., 1] / z + camera.cy,
        ],
        -1,
    )
    # A box is drawn around the part of the robot inside the image.
    shown = (pixels >= 0) & (pixels <= [camera.width, camera.height])
    span = np.tile(box.box_px[2:] - box.box_px[:2], 2)
    rows = np.arange(len(points))
    gaps, J = np.empty((len(points), 4)), np.empty((len(points), 4, 4))
    for side in range(4):
        axis = side % 2
        focal = camera.fx if axis == 0 else camera.fy
        seen = pixels[..., axis]
        outside = ~shown[..., 1 - axis] & shown[..., 1 - axis].any(1, keepdims=True)
        outwards = -1 if side < 2 else 1
        extreme = np.argmax(np.where(outside, -np.inf, outwards * seen), axis=1)
        gaps[:, side] = (seen[rows, extreme] - sides[:, side]) / span[side]
        zs, p = z[rows, extreme], points_cam[rows, extreme]
        along = focal * (R[axis] / zs[:, None] - p[:, axis, None] * R[2] / zs[:, None] ** 2) / span[side]
        J[:, side, :3] = along * depth[:, None]
        J[:, side, 3] = np.einsum("hd,hd->h", along, arms[rows, extreme])
    outward = np.array([-1.0, -1.0, 1.0, 1.0])
    # A side on the image border is only a lower limit of the robot's extent.
    free = cut & (gaps * outward > 0)
    return np.where(free, 0.0, np.clip(gaps, -5, 5)), np.where(free[..., None], 0.0, J)
