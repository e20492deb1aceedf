"""Generated scenes on which the splatting engine is timed and checked."""

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.transforms import quat_from_matrix

FIRST_OBJECT = 4  # surfaces of the table-top scene before it are flat


def table_top(count: int, sh_degree: int, seed: int = 0) -> Gaussians:
    """Make flattened Gaussians on a table, a floor, two walls and 24 round objects."""
    return table_top_surfaces(count, sh_degree, seed)[0]


def table_top_surfaces(count: int, sh_degree: int, seed: int = 0) -> tuple[Gaussians, NDArray[np.int64]]:
    """Make `table_top`, and the surface of every Gaussian (N,), 0..27."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform([-0.8, -0.5, 0.05], [0.8, 0.5, 0.45], (24, 3))
    radii = rng.uniform(0.03, 0.12, (24, 3))
    planes = np.array(  # origin, two sides
        [
            [[-1, -0.7, 0], [2, 0, 0], [0, 1.4, 0]],
            [[-2.5, -2.5, -0.8], [5, 0, 0], [0, 5, 0]],
            [[-2.5, 2.5, -0.8], [5, 0, 0], [0, 0, 3]],
            [[-2.5, -2.5, -0.8], [0, 5, 0], [0, 0, 3]],
        ],
        np.float64,
    )
    plane_areas = np.linalg.norm(np.cross(planes[:, 1], planes[:, 2]), axis=1)
    areas = np.concatenate([plane_areas, 4 * np.pi * radii.prod(1) ** (2 / 3)])
    shares = areas * ([4, 1, 1, 1] + [12] * 24)
    part = rng.choice(28, count, p=shares / shares.sum())
    spacing = np.sqrt(areas / np.maximum(np.bincount(part, minlength=28), 1))[part]
    on_plane, ball = part < 4, np.maximum(part - 4, 0)
    plane = planes[np.minimum(part, 3)]
    across = np.cross(plane[:, 1], plane[:, 2])
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    normal = np.where(on_plane[:, None], across / np.linalg.norm(across, axis=1, keepdims=True), direction)
    flat = plane[:, 0] + rng.random((count, 1)) * plane[:, 1] + rng.random((count, 1)) * plane[:, 2]
    means = np.where(on_plane[:, None], flat, centers[ball] + direction * radii[ball])
    return _flattened(means, normal, spacing, part, sh_degree, rng), part


def table_camera(width: int, height: int, share: float = 0.5) -> Camera:
    """Make a view of the table from an arc in front of it; share 0..1 along the arc."""
    angle = -np.pi / 2 + (share - 0.5) * 1.6
    pose = look_at([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.9], [0, 0, 0.1])
    focal = 0.5 * width / np.tan(np.radians(30))
    return Camera(
        fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height, T_world_cam=pose
    )


def ellipsoids(
    count: int, centers: np.ndarray, radii: np.ndarray, sh_degree: int, seed: int = 0
) -> Gaussians:
    """Make flattened Gaussians on E ellipsoids with centres and radii (E, 3), [m]; equally many on each."""
    rng = np.random.default_rng(seed)
    part = np.arange(count) % len(centers)
    areas = 4 * np.pi * radii.prod(1) ** (2 / 3)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    spacing = np.sqrt(areas * len(centers) / count)[part]
    return _flattened(centers[part] + direction * radii[part], direction, spacing, part, sh_degree, rng)


def _flattened(
    points: np.ndarray,
    normals: np.ndarray,
    spacing: np.ndarray,
    part: np.ndarray,
    sh_degree: int,
    rng: np.random.Generator,
) -> Gaussians:
    """Make Gaussians at surface points (N, 3), thin along the normals, as large as the point spacing [m]."""
    count, parts = len(points), int(part.max()) + 1
    means = points + 0.1 * spacing[:, None] * rng.normal(size=(count, 3))
    log_scales = np.log(0.6 * spacing)[:, None] + 0.5 * rng.normal(size=(count, 3)) - [0, 0, 1.5]
    sh = 0.05 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))
    color = rng.random((parts, 3))[part] + 0.15 * np.sin(means @ (12 * rng.normal(size=(3, 3))))
    sh[:, 0] = (np.clip(color, 0.02, 0.98) - 0.5) / SH_C0
    return Gaussians(
        means=means.astype(np.float32),
        quats=_quats_along(normals, rng.uniform(0, 2 * np.pi, count)).astype(np.float32),
        scales=np.exp(log_scales).astype(np.float32),
        opacities=(1 / (1 + np.exp(-rng.normal(1, 2, count)))).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _quats_along(normals: np.ndarray, spins: np.ndarray) -> np.ndarray:
    """Compute rotations (N, 4) wxyz whose z axis is the normal, with a rotation about it."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    c, s = np.cos(spins)[:, None], np.sin(spins)[:, None]
    return quat_from_matrix(np.stack([x * c + y * s, y * c - x * s, normals], 2))
