"""A checkered table with a ball, cameras around it, and poor initial Gaussians for training."""

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.rasterizer import render


def ring(count: int, height: float = 0.7, shift: float = 0.0) -> list[Camera]:
    angles = 2 * np.pi * (np.arange(count) + shift) / count
    eyes = np.stack([1.6 * np.cos(angles), 1.6 * np.sin(angles), np.full(count, height)], 1)
    return [
        Camera(fx=95.0, fy=95.0, cx=48.0, cy=36.0, width=96, height=72, T_world_cam=look_at(eye, [0, 0, 0.1]))
        for eye in eyes
    ]


def checkered(count: int, seed: int) -> Gaussians:
    """Create opaque Gaussians on a table and a ball, in a coarse checker pattern."""
    rng = np.random.default_rng(seed)
    half = count // 2
    table = np.column_stack([rng.uniform(-1, 1, (half, 2)), np.zeros(half)])
    ball = rng.normal(size=(count - half, 3))
    ball = 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0, 0, 0.3]
    means = np.concatenate([table, ball])
    dark = (np.floor(means * 4).sum(1) % 2)[:, None]
    color = np.where(dark, [0.15, 0.2, 0.5], [0.9, 0.7, 0.3])
    return Gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.03),
        opacities=np.full(count, 0.95),
        sh=((color - 0.5) / 0.28209479)[:, None],
    )


def photograph(scene: Gaussians, cameras: list[Camera]) -> list[np.ndarray]:
    return [(render(scene, camera).rgb * 255).round().astype(np.uint8) for camera in cameras]


def start(scene: Gaussians, count: int) -> Gaussians:
    """Select some of the scene's points, displaced, gray and half transparent."""
    rng = np.random.default_rng(3)
    some = scene.select(rng.choice(len(scene), count, replace=False))
    return Gaussians(
        means=some.means + rng.normal(size=some.means.shape) * 0.01,
        quats=some.quats,
        scales=some.scales * 1.3,
        opacities=np.full(count, 0.5),
        sh=np.zeros((count, 1, 3)),
    )
