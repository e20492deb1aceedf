"""Coarse starts for the alignment: which way is up, then a sweep over yaw on the prompted boxes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply, similarity
from aomgen.core.values import Array, freeze

BORDER_PX = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotBox:
    """A box around the robot in one scan image.

    Attributes:
        camera_recon: Camera of the image.
        box_px: x0, y0, x1, y1 (4,), [px]; a side on the image border may hide more robot.
    """

    camera_recon: Camera
    box_px: Array

    def __post_init__(self) -> None:
        freeze(self, "box_px", self.box_px, (4,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """One coarse hypothesis: the similarity and how well its boxes fit (share of their size)."""

    S_world_recon: Array
    misfit: float


def up_candidates(
    cameras_recon: list[Camera], points_recon: Array, rng: np.random.Generator, count: int = 2
) -> list[Array]:
    """Likely up directions (3,) in the recon frame, best first.

    People hold cameras upright, so up lies near the mean of the cameras' own; the large planes of
    the scene (table, floor) sharpen it. Planes tilted more than 30 degrees from it are walls.

    Args:
        cameras_recon: Scan cameras.
        points_recon: Sparse or dense points (P, 3).
        rng: Chooses the triples of the plane search.
        count: How many plane normals to return before the plain mean.
    """
    mean_up = -np.mean([camera.T_world_cam[:3, 1] for camera in cameras_recon], 0)
    mean_up /= np.linalg.norm(mean_up)
    ups: list[Array] = []
    left = np.asarray(points_recon, np.float64)
    extent = np.median(np.linalg.norm(left - np.median(left, 0), axis=1)) if len(left) else 1.0
    for _ in range(count):
        if len(left) < 50:
            break
        normal, near = _largest_plane(left, mean_up, 0.01 * extent, rng)
        if near.sum() < 0.03 * len(points_recon):
            break
        if all(normal @ up < np.cos(np.radians(2.0)) for up in ups):
            ups.append(normal)
        left = left[~near]
    return [*ups, mean_up]


def _largest_plane(
    points: Array, up: Array, tolerance: float, rng: np.random.Generator, trials: int = 1500
) -> tuple[Array, NDArray[np.bool_]]:
    """Normal (3,) towards `up` and members (P,) of the plane that most points lie on."""
    triples = points[rng.integers(0, len(points), (trials, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-12)[:, None]
    normals *= np.sign(normals @ up)[:, None]
    usable = (lengths > 1e-9) & (normals @ up > np.cos(np.radians(30.0)))
    if not usable.any():
        return up, np.zeros(len(points), bool)
    normals, anchors = normals[usable], triples[usable, 0]
    offsets = np.einsum("td,td->t", normals, anchors)
    sample = points[rng.permutation(len(points))[:2000]]
    counts = (np.abs(sample @ normals.T - offsets) < tolerance).sum(0)
    best = int(np.argmax(counts))
    normal, offset = normals[best], offsets[best]
    for _ in range(3):
        near = np.abs(points @ normal - offset) < tolerance
        if near.sum() < 3:
            break
        center = points[near].mean(0)
        normal = np.linalg.svd(points[near] - center, full_matrices=False)[2][2]
        normal *= np.sign(normal @ up)
        offset = normal @ center
    return normal, np.abs(points @ normal - offset) < 2 * tolerance


def sweep_yaw(boxes: list[RobotBox], vertices_world: Array, up_recon: Array, steps: int = 48) -> list[Start]:
    """For each yaw the scale and position whose projected robot fills the boxes best.

    Args:
        boxes: Prompted boxes, one or more.
        vertices_world: Points on the posed robot (V, 3), [m].
        up_recon: World z in the recon frame (3,).
        steps: Yaw angles tried.

    Returns:
        Local minima over yaw, best first.

    Source: own; the box sides are what a projected convex hull must touch.
    """
    R_upright = _upright(up_recon)
    # A projection's extent is that of the convex hull.
    vertices_world = vertices_world[ConvexHull(vertices_world).vertices]
    starts = []
    for yaw in np.arange(steps) * 2 * np.pi / steps:
        c, s = np.cos(yaw), np.sin(yaw)
        R_world_recon = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ R_upright
        starts.append(_fit_boxes(boxes, vertices_world, R_world_recon))
    misfits = np.array([start.misfit for start in starts])
    minima = (misfits <= np.roll(misfits, 1)) & (misfits <= np.roll(misfits, -1))
    return sorted((starts[i] for i in np.flatnonzero(minima)), key=lambda start: start.misfit)


def _upright(up: Array) -> Array:
    """A rotation (3, 3) that carries `up` onto z."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _fit_boxes(boxes: list[RobotBox], vertices_world: Array, R_world_recon: Array) -> Start:
    middle = (vertices_world.min(0) + vertices_world.max(0)) / 2
    turned = (vertices_world - middle) @ R_world_recon
    size = np.linalg.norm(np.ptp(vertices_world, axis=0))
    center, depth = _where_boxes_meet(boxes)
    first = boxes[0]
    diagonal = np.linalg.norm(first.box_px[2:] - first.box_px[:2])
    scale_recon = depth * diagonal / first.camera_recon.fx / size

    def residuals(x: Array) -> Array:
        points = turned * (scale_recon * np.exp(x[3])) + center + depth * x[:3]
        return np.concatenate([_box_residuals(box, points) for box in boxes])

    fit = least_squares(residuals, np.zeros(4), loss="soft_l1", f_scale=0.1, max_nfev=40)
    s_recon = scale_recon * np.exp(fit.x[3])
    p_recon = center + depth * fit.x[:3]
    # p_recon_point = s_recon * R^T (p_world - middle) + p_recon, turned around:
    S = similarity(1 / s_recon, R_world_recon, middle - R_world_recon @ p_recon / s_recon)
    return Start(S_world_recon=S, misfit=float(np.sqrt(np.mean(fit.fun**2))))


def _where_boxes_meet(boxes: list[RobotBox]) -> tuple[Array, float]:
    """Point nearest to the rays through the boxes' centres, and its depth in the first camera."""
    A, b, rays = np.zeros((3, 3)), np.zeros(3), []
    for box in boxes:
        camera = box.camera_recon
        u, v = (box.box_px[:2] + box.box_px[2:]) / 2
        ray = camera.T_world_cam[:3, :3] @ [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]
        ray /= np.linalg.norm(ray)
        P = np.eye(3) - np.outer(ray, ray)
        A += P
        b += P @ camera.center
        rays.append(ray)
    baseline = max(float(np.linalg.norm(a.camera_recon.center - boxes[0].camera_recon.center)) for a in boxes)
    if baseline < 1e-6:
        return boxes[0].camera_recon.center + rays[0], 1.0
    center = np.linalg.solve(A + 1e-6 * np.eye(3), b + 1e-6 * (boxes[0].camera_recon.center + rays[0]))
    depth = float((center - boxes[0].camera_recon.center) @ boxes[0].camera_recon.T_world_cam[:3, 2])
    if depth < 0.1 * baseline:
        center, depth = boxes[0].camera_recon.center + baseline * rays[0], baseline
    return center, depth


def _box_residuals(box: RobotBox, points_recon: Array) -> Array:
    """Four signed gaps between box sides and projected extent, as shares of the box's size."""
    camera = box.camera_recon
    points_cam = apply(camera.T_cam_world, points_recon)
    z = np.maximum(points_cam[:, 2], 0.05 * np.abs(points_cam[:, 2]).mean() + 1e-6)
    u = camera.fx * points_cam[:, 0] / z + camera.cx
    v = camera.fy * points_cam[:, 1] / z + camera.cy
    x0, y0, x1, y1 = box.box_px
    span = np.array([x1 - x0, y1 - y0, x1 - x0, y1 - y0])
    gaps = np.array([u.min() - x0, v.min() - y0, u.max() - x1, v.max() - y1]) / span
    limits = np.array([x0, y0, camera.width - x1, camera.height - y1])
    outward = np.array([-1.0, -1.0, 1.0, 1.0])
    # A box cut by the image border says only that the robot reaches at least that far.
    gaps = np.where((limits <= BORDER_PX) & (gaps * outward > 0), 0.0, gaps)
    return np.clip(gaps, -5, 5)
