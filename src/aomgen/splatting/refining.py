"""Gaussians of moving parts fitted to images of many joint configurations, in the parts' own frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.values import Array
from aomgen.splatting import native
from aomgen.splatting.compute import NativeCompute, image_loss
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, PartTensors, RasterOptions
from aomgen.splatting.optimizer import RATES, Parameters, gaussians_of, parameter_rates, parameters_of
from aomgen.splatting.training import one_torch_thread

# What is left of all learning rates at the end, so that the last steps only average.
DECAY = 0.1
# Passes over all images.
ROUNDS = 2
# As in training, but opacity stays: a surface is opaque.
REFINING_RATES: Final = {**RATES, "log_scales": 2e-2, "logit_opacities": 0.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementView:
    """An image of one joint configuration.

    Attributes:
        camera: Where it was taken.
        image_srgb: (H, W, 3) uint8.
        Ts_world_part: Poses of the parts (P, 4, 4).
        colors_srgb: Colors (M, 3) of the last Gaussians in this configuration, in the place of their
            harmonics' constant term.
        recall: Share (M,) of the fitted difference in color that is seen in this configuration.
        shade: Factors (H, W, 3) on the drawn colors, for shadows that are not the Gaussians' own.
        unsure: Pixels (H, W) that are left out of the loss.
    """

    camera: Camera
    image_srgb: NDArray[np.uint8]
    Ts_world_part: Array
    colors_srgb: NDArray[np.float32]
    recall: NDArray[np.float32]
    shade: NDArray[np.float32] | None = None
    unsure: NDArray[np.bool_] | None = None


def refine_gaussians(
    gaussians: Gaussians,
    parts: NDArray[np.int32],
    views: Sequence[RefinementView],
    rate_means: float,
    rng: np.random.Generator,
) -> tuple[Gaussians, Array]:
    """Fit Gaussians of moving parts to images.

    Args:
        gaussians: N, in the frames of their parts; the last M are those with colors in the views.
        parts: Part of every Gaussian (N,).
        views: At least one.
        rate_means: Learning rate of the means at the start, [m] a step.
        rng: Order of the images.

    Returns:
        The fitted Gaussians (N), the constant term of the last M as it was, and differences in
        color (M, 3), sRGB, that `RefinementView.recall` weighs.

    Raises:
        BackendError: The splatting engine is missing or refuses the scene.
    """
    degree, lit = gaussians.sh_degree, len(views[0].recall)
    parameters = parameters_of(gaussians, degree)
    first = len(gaussians) - lit
    parameters.values["sh"][first:, 0] = 0
    steps, order = ROUNDS * len(views), np.zeros(0, np.int64)
    compute, contexts = NativeCompute(), (native.Context(), native.Context(threads=1))
    indices = torch.tensor(np.asarray(parts, np.int32))
    with one_torch_thread():
        for step in range(steps):
            if not len(order):
                order = rng.permutation(len(views))
            view, order = views[int(order[0])], order[1:]
            gradients = _gradients(parameters, indices, view, contexts)
            decay = DECAY ** (step / steps)
            rates = parameter_rates(REFINING_RATES, rate_means * decay, decay, degree)
            parameters.step(gradients, rates, compute)
    result = gaussians_of(parameters)
    sh = np.array(result.sh)
    difference = sh[first:, 0].astype(np.float64) * SH_C0
    sh[first:, 0] = gaussians.sh[first:, 0]
    # Exactly as they came: a logit and back rounds.
    kept = Gaussians(
        means=result.means, quats=result.quats, scales=result.scales, opacities=gaussians.opacities, sh=sh
    )
    return kept, difference


def _gradients(
    parameters: Parameters,
    indices: Tensor,
    view: RefinementView,
    contexts: tuple[native.Context, native.Context],
) -> dict[str, Tensor]:
    """Gradients of one image's loss, by name; `contexts` of the rasterizer and of the loss."""
    leaves = parameters.leaves()
    Ts_world_part = torch.tensor(view.Ts_world_part, dtype=torch.float32)
    options = RasterOptions(sh_degree=int(np.sqrt(leaves["sh"].shape[1])) - 1)
    drawn = CpuRasterizer(contexts[0])(
        GaussianTensors(**{**leaves, "sh": _harmonics(leaves["sh"], view)}),
        view.camera,
        options,
        parts=PartTensors(indices=indices, Ts_world_part=Ts_world_part),
    )
    target = torch.tensor(np.ascontiguousarray(view.image_srgb.transpose(2, 0, 1))).float() / 255
    rgb = drawn.rgb
    if view.shade is not None:
        rgb = rgb * torch.tensor(np.ascontiguousarray(view.shade.transpose(2, 0, 1)))
    if view.unsure is not None:
        target = torch.where(torch.tensor(view.unsure), rgb.detach(), target)
    image_loss(rgb, target, context=contexts[1]).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _harmonics(learned: Tensor, view: RefinementView) -> Tensor:
    """Harmonics (N, K, 3) of a configuration: the last M are lit, and differ by a share of the fitted difference."""
    constant = torch.tensor((view.colors_srgb - 0.5) / SH_C0, dtype=torch.float32)
    recall = torch.tensor(view.recall, dtype=torch.float32)
    first = len(learned) - len(recall)
    lit = constant + recall[:, None] * learned[first:, 0]
    constants = torch.cat([learned[:first, 0], lit])
    return torch.cat([constants[:, None], learned[:, 1:]], 1)
