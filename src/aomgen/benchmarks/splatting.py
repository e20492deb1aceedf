"""Speed of the splatting engine on a table-top scene, on this machine."""

import time
from dataclasses import dataclass

import numpy as np
import torch

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.transforms import quat_from_matrix
from aomgen.splatting import native
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, RasterOptions
from aomgen.splatting.loss import image_loss
from aomgen.splatting.rasterizer import render


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedCase:
    """One scene and machine setting.

    Attributes:
        gaussians: Number of Gaussians in the scene; a good half of them is in view.
        width, height: Image size, [px].
        sh_degree: 0..3.
        threads: Worker threads, None for all processors.
        instruction_set: One of `native.instruction_sets()`, None for the best.
        repeats: Timed runs, of which the median counts.
    """

    gaussians: int = 100_000
    width: int = 640
    height: int = 480
    sh_degree: int = 3
    threads: int | None = None
    instruction_set: str | None = None
    repeats: int = 15


DEFAULT_CASES = (
    SpeedCase(),
    SpeedCase(gaussians=20_000),
    SpeedCase(gaussians=300_000),
    SpeedCase(sh_degree=0),
    SpeedCase(threads=1),
)


def measure(cases: tuple[SpeedCase, ...] = DEFAULT_CASES) -> list[dict]:
    """Median wall times of every case, [ms].

    Returns:
        For each case a dict with the case's fields and: render_ms (numpy interface), forward_ms
        (torch), train_step_ms (forward, loss, backward), loss_ms, stages_ms, visible, pairs.
    """
    return [_measure_case(case) for case in cases]


def table_top(count: int, sh_degree: int, seed: int = 0) -> Gaussians:
    """Flattened Gaussians on a table, a floor, two walls and 24 round objects."""
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
    means += 0.1 * spacing[:, None] * rng.normal(size=(count, 3))
    log_scales = np.log(0.6 * spacing)[:, None] + 0.5 * rng.normal(size=(count, 3)) - [0, 0, 1.5]
    sh = 0.05 * rng.normal(size=(count, (sh_degree + 1) ** 2, 3))
    color = rng.random((28, 3))[part] + 0.15 * np.sin(means @ (12 * rng.normal(size=(3, 3))))
    sh[:, 0] = (np.clip(color, 0.02, 0.98) - 0.5) / SH_C0
    return Gaussians(
        means=means.astype(np.float32),
        quats=_quats_along(normal, rng.uniform(0, 2 * np.pi, count)).astype(np.float32),
        scales=np.exp(log_scales).astype(np.float32),
        opacities=(1 / (1 + np.exp(-rng.normal(1, 2, count)))).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def table_camera(width: int, height: int, share: float = 0.5) -> Camera:
    """A view of the table from an arc in front of it; share 0..1 along the arc."""
    angle = -np.pi / 2 + (share - 0.5) * 1.6
    pose = look_at([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.9], [0, 0, 0.1])
    focal = 0.5 * width / np.tan(np.radians(30))
    return Camera(
        fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height, T_world_cam=pose
    )


def _measure_case(case: SpeedCase) -> dict:
    gaussians = table_top(case.gaussians, case.sh_degree)
    camera = table_camera(case.width, case.height)
    context = native.Context(case.threads, case.instruction_set)
    leaves = [
        torch.tensor(array).requires_grad_()
        for array in (
            gaussians.means,
            gaussians.quats,
            np.log(gaussians.scales),
            np.log(gaussians.opacities / (1 - gaussians.opacities)).clip(-15, 15),
            gaussians.sh,
        )
    ]

    rasterizer, options = CpuRasterizer(context), RasterOptions(sh_degree=case.sh_degree)
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")

    def forward() -> torch.Tensor:
        drawn = rasterizer(GaussianTensors(**dict(zip(names, leaves, strict=True))), camera, options)
        return drawn.rgb

    target = forward().detach() * 0.9
    rendered = target.clone().requires_grad_()
    times = {
        "forward_ms": _median_ms(forward, case.repeats),
        "train_step_ms": _median_ms(
            lambda: image_loss(forward(), target, context=context).backward(), case.repeats
        ),
        "stages_ms": context.stage_times_ms(),
        "loss_ms": _median_ms(lambda: image_loss(rendered, target, context=context), case.repeats),
    }
    if case.instruction_set is None:
        times["render_ms"] = _median_ms(lambda: render(gaussians, camera, threads=case.threads), case.repeats)
    visible, pairs = context.counts()
    fields = {name: getattr(case, name) for name in case.__slots__}
    return fields | times | {"visible": visible, "pairs": pairs}


def _median_ms(function, repeats: int) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def _quats_along(normals: np.ndarray, spins: np.ndarray) -> np.ndarray:
    """Rotations (N, 4) wxyz whose z axis is the normal, turned about it."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    c, s = np.cos(spins)[:, None], np.sin(spins)[:, None]
    return quat_from_matrix(np.stack([x * c + y * s, y * c - x * s, normals], 2))
