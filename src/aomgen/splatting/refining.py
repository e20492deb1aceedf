"""Gaussians of moving parts fitted to pictures of many postures, in the parts' own frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.values import Array
from aomgen.splatting import native
from aomgen.splatting.compute import NativeCompute
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, PartTensors, RasterOptions
from aomgen.splatting.loss import image_loss
from aomgen.splatting.optimizer import NAMES, Parameters, gaussians_of, parameters_of
from aomgen.splatting.training import one_torch_thread


@dataclass(frozen=True, slots=True, kw_only=True)
class Lesson:
    """One picture of a posture.

    Attributes:
        camera: Where it was taken.
        image_srgb: (H, W, 3) uint8.
        Ts_world_part: Poses of the parts (P, 4, 4).
        colors_srgb: Colors (M, 3) of the free Gaussians in this posture, in the place of their
            harmonics' constant term.
        recall: Share (M,) of the learned difference in color that is seen in this posture.
    """

    camera: Camera
    image_srgb: NDArray[np.uint8]
    Ts_world_part: Array
    colors_srgb: Array
    recall: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RefiningParams:
    """How long and how boldly.

    Attributes:
        rounds: How often every picture is learned from.
        rate_means: Of places, [m] a step; it falls by `decay` until the end, as all others do.
        rate_quats, rate_log_scales, rate_color, rate_sh: Others. Opacity stays: a surface is opaque.
        decay: What is left of the rates at the end.
        dssim_weight: Share of the structural part in the loss.
    """

    rounds: int = 3
    rate_means: float = 1e-4
    rate_quats: float = 4e-3
    rate_log_scales: float = 2e-2
    rate_color: float = 2e-2
    rate_sh: float = 5e-3
    decay: float = 0.1
    dssim_weight: float = 0.2


def refined(
    still: Gaussians,
    free: Gaussians,
    parts: NDArray[np.int32],
    lessons: Sequence[Lesson],
    params: RefiningParams,
    rng: np.random.Generator,
) -> tuple[Gaussians, Array]:
    """Fit Gaussians of moving parts to pictures.

    Args:
        still: What else is in the pictures (N), each in its part's frame; it stays as it is.
        free: What is fitted (M), in the frames of its parts.
        parts: Part of every Gaussian (N + M,), the still ones first.
        lessons: At least one.
        params: Length and rates.
        rng: Order of the pictures.

    Returns:
        The fitted Gaussians (M), their constant term as it was, and differences in color (M, 3),
        sRGB, that `Lesson.recall` weighs.

    Raises:
        BackendError: The splatting engine is missing or refuses the scene.
    """
    degree = max(still.sh_degree, free.sh_degree)
    backdrop, parameters = parameters_of(still, degree).values, parameters_of(free, degree)
    parameters.values["sh"][:, 0] = 0
    steps, order = params.rounds * len(lessons), np.zeros(0, np.int64)
    compute, contexts = NativeCompute(), (native.Context(), native.Context(threads=1))
    indices = torch.tensor(np.asarray(parts, np.int32))
    with one_torch_thread():
        for step in range(steps):
            if not len(order):
                order = rng.permutation(len(lessons))
            lesson, order = lessons[int(order[0])], order[1:]
            gradients = _gradients(backdrop, parameters, indices, lesson, params.dssim_weight, contexts)
            parameters.step(gradients, _rates(params, step / steps, degree), compute)
    result = gaussians_of(parameters)
    sh = np.array(result.sh)
    difference = sh[:, 0].astype(np.float64) * SH_C0
    sh[:, 0] = free.sh[:, 0]
    # Exactly as they came: a logit and back rounds.
    kept = Gaussians(
        means=result.means, quats=result.quats, scales=result.scales, opacities=free.opacities, sh=sh
    )
    return kept, difference


def _gradients(
    backdrop: dict[str, Tensor],
    parameters: Parameters,
    indices: Tensor,
    lesson: Lesson,
    dssim_weight: float,
    contexts: tuple[native.Context, native.Context],
) -> dict[str, Tensor]:
    """Gradients of one picture's loss, by name; `contexts` of the rasterizer and of the loss."""
    leaves = parameters.leaves()
    scene = _scene(backdrop, leaves, lesson)
    Ts_world_part = torch.tensor(lesson.Ts_world_part, dtype=torch.float32)
    options = RasterOptions(sh_degree=int(np.sqrt(leaves["sh"].shape[1])) - 1)
    drawn = CpuRasterizer(contexts[0])(
        scene, lesson.camera, options, parts=PartTensors(indices=indices, Ts_world_part=Ts_world_part)
    )
    target = torch.tensor(np.ascontiguousarray(lesson.image_srgb.transpose(2, 0, 1))).float() / 255
    image_loss(drawn.rgb, target, dssim_weight=dssim_weight, context=contexts[1]).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _scene(backdrop: dict[str, Tensor], leaves: dict[str, Tensor], lesson: Lesson) -> GaussianTensors:
    constant = torch.tensor((np.asarray(lesson.colors_srgb) - 0.5) / SH_C0, dtype=torch.float32)
    recall = torch.tensor(np.asarray(lesson.recall), dtype=torch.float32)
    free = dict(leaves)
    learned = leaves["sh"]
    first = constant + recall[:, None] * learned[:, 0]
    free["sh"] = torch.cat([first[:, None], learned[:, 1:]], 1)
    return GaussianTensors(**{name: torch.cat([backdrop[name], free[name]]) for name in NAMES})


def _rates(params: RefiningParams, share: float, degree: int) -> dict[str, Tensor]:
    decay = params.decay**share
    by_coefficient = [params.rate_color] + [params.rate_sh] * ((degree + 1) ** 2 - 1)
    return {
        "means": torch.full((3,), params.rate_means * decay),
        "quats": torch.full((4,), params.rate_quats * decay),
        "log_scales": torch.full((3,), params.rate_log_scales * decay),
        "logit_opacities": torch.zeros(1),
        "sh": torch.tensor(by_coefficient).repeat_interleave(3) * decay,
    }
