"""Fit of the whole twin to the images of scan and demonstration, each in its joint configuration.

The scan shows one joint configuration. The video shows surfaces that were hidden in it: the interior of the opened
object, the other side of a door, and the table without the shadow of the arm at rest. Gaussians remain opaque surfaces
on their bodies. Transient shadows of moving bodies have little influence, because the loss is an absolute difference
and the shadows are at different positions in every image.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from aomgen.appearance.surfel_observations import pixel_size
from aomgen.conventions import illuminate_srgb
from aomgen.core.camera import Camera
from aomgen.core.gaussians import BLACK, SH_C0
from aomgen.core.values import Array
from aomgen.lighting.plane_shadow import select_casters
from aomgen.lighting.shadowed_twin import observe_shadow
from aomgen.robots.robot import RobotModel
from aomgen.splatting import native
from aomgen.splatting.compute import NativeCompute, image_loss
from aomgen.splatting.differentiable import CpuRasterizer, GaussianTensors, PartTensors, RasterOptions
from aomgen.splatting.optimizer import RATES, Parameters, gaussians_of, parameter_rates, parameters_of
from aomgen.splatting.training import one_torch_thread
from aomgen.twin.relighting import Relit
from aomgen.twin.twin import PosedImages, TwinModel, TwinState, body_poses

# Displacement of Gaussians in a step, [px] of a typical image at the distance of the robot.
STEP_PX: Final = 0.1
# Rendered shadows are displaced by a pixel or two. Therefore pixels are left out of the loss if the blocked share of
# the light changes by EDGE_STEP within EDGE_PX and the surface covers more than half of the pixel.
EDGE_PX, EDGE_STEP = 5, 0.1
# Final learning rates as a share of the initial ones, so that the last steps average the result.
DECAY: Final = 0.1
# Passes over all images.
ROUNDS: Final = 2
# As in training, but opacities are fixed, because surfaces are opaque.
REFINING_RATES: Final = {**RATES, "log_scales": 2e-2, "logit_opacities": 0.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """An image of one joint configuration.

    Attributes:
        camera: Camera of the image.
        image_srgb: (H, W, 3) uint8.
        Ts_world_body: Body poses (B, 4, 4).
        colors_srgb: Colors (M, 3) of relit surfaces in this configuration.
        recall: Share (M,) of the fitted color difference that applies in this configuration.
        shade: Factors (H, W, 3) on the rendered colors, for shadows that are not in the colors of the Gaussians.
        unsure: Pixels (H, W) that are left out of the loss.
    """

    camera: Camera
    image_srgb: NDArray[np.uint8]
    Ts_world_body: Array
    colors_srgb: NDArray[np.float32]
    recall: NDArray[np.float32]
    shade: NDArray[np.float32] | None = None
    unsure: NDArray[np.bool_] | None = None


def refine_twin(
    twin: TwinModel, robot: RobotModel, views: Sequence[PosedImages], rng: np.random.Generator
) -> TwinModel:
    """Fit the Gaussians of the twin to images in a random order; without images the twin is not changed.

    Shape, specular terms and the colors of surfaces that are not relit are shared by all joint configurations. For
    relit surfaces, which are the last Gaussians of the twin, a color difference is learned for the orientations of
    the scan; it is weighted like the residuals of these orientations (see `twin.relighting`).
    """
    if not views:
        return twin
    nearest, casters = _scan_orientations(twin, robot), select_casters(twin, robot)
    prepared = []
    for view in views:
        for image, state in zip(view.images_srgb, view.states, strict=True):
            item = _prepare_view(twin, robot, nearest, view.camera, image, state)
            prepared.append(_with_shadows(item, twin, casters))
    parameters = _fit(twin, prepared, STEP_PX * pixel_size(robot, twin, views), rng)
    fitted = gaussians_of(parameters)
    first = len(fitted) - len(twin.relit_bodies)
    sh = np.array(fitted.sh)
    difference = sh[first:, 0].astype(np.float64) * SH_C0
    sh[first:, 0] = twin.gaussians.sh[first:, 0]
    # The original opacities, because converting to logits and back would round them.
    gaussians = replace(fitted, opacities=twin.gaussians.opacities, sh=sh)
    relit = None if twin.relit is None else _add_corrections(twin.relit, nearest, difference)
    return replace(twin, gaussians=gaussians, relit=relit)


def _scan_orientations(twin: TwinModel, robot: RobotModel) -> dict[int, int]:
    """Return, for every body, the index of the stored orientation that is nearest to that of the scan."""
    Ts = body_poses(twin, robot, twin.scan_state)
    return {
        item.body: int(np.argmax(np.einsum("kij,ij->k", item.Rs_world_body, Ts[item.body, :3, :3])))
        for item in (twin.relit.residuals if twin.relit is not None else ())
    }


def _prepare_view(
    twin: TwinModel,
    robot: RobotModel,
    nearest: dict[int, int],
    camera: Camera,
    image_srgb: NDArray[np.uint8],
    state: TwinState,
) -> _View:
    """Combine an image with the colors of relit surfaces in its joint configuration."""
    Ts = body_poses(twin, robot, state)
    colors, recall = np.zeros((0, 3), np.float32), np.zeros(len(twin.relit_bodies), np.float32)
    if twin.relit is not None:
        colors = twin.relit.colors_srgb(twin.relit_bodies, Ts[None])[0].astype(np.float32)
        for item in twin.relit.residuals:
            recall[item.rows] = item.weights(Ts[None, item.body, :3, :3])[0, nearest[item.body]]
    return _View(camera=camera, image_srgb=image_srgb, Ts_world_body=Ts, colors_srgb=colors, recall=recall)


def _with_shadows(view: _View, twin: TwinModel, casters: tuple[TwinModel, TwinModel]) -> _View:
    """Add the shadows of its joint configuration to a view."""
    directional = twin.directional_light
    if directional is None:
        return view
    surface, blocked = observe_shadow(twin, directional, casters, view.Ts_world_body, view.camera)
    edge = maximum_filter(blocked, EDGE_PX) - minimum_filter(blocked, EDGE_PX) > EDGE_STEP
    # The factor on an sRGB color depends on the color, which is that of the image.
    seen = np.maximum(view.image_srgb / 255.0, BLACK)
    shade = seen / illuminate_srgb(seen, 1 / (1 - (surface * blocked)[..., None] * directional.share))
    return replace(view, shade=shade.astype(np.float32), unsure=edge & (surface > 0.5))


def _add_corrections(relit: Relit, nearest: dict[int, int], difference: Array) -> Relit:
    """Add color differences (M, 3) to the residuals of the orientations of the scan."""
    remembered = []
    for item in relit.residuals:
        colors = np.array(item.difference_srgb)
        colors[nearest[item.body]] += difference[item.rows]
        remembered.append(replace(item, difference_srgb=colors))
    return replace(relit, residuals=tuple(remembered))


def _fit(twin: TwinModel, views: list[_View], rate_means: float, rng: np.random.Generator) -> Parameters:
    """Fit Gaussians in the frames of their bodies; the constant terms of relit ones are color differences.

    Args:
        rate_means: Initial learning rate of the means, [m] per step.
    """
    degree = twin.gaussians.sh_degree
    parameters = parameters_of(twin.gaussians, degree)
    parameters.values["sh"][len(twin.gaussians) - len(twin.relit_bodies) :, 0] = 0
    steps, order = ROUNDS * len(views), np.zeros(0, np.int64)
    compute, contexts = NativeCompute(), (native.Context(), native.Context(threads=1))
    bodies = torch.tensor(twin.bodies)
    with one_torch_thread():
        for step in range(steps):
            if not len(order):
                order = rng.permutation(len(views))
            view, order = views[int(order[0])], order[1:]
            gradients = _gradients(parameters, bodies, view, contexts)
            decay = DECAY ** (step / steps)
            rates = parameter_rates(REFINING_RATES, rate_means * decay, decay, degree)
            parameters.step(gradients, rates, compute)
    return parameters


def _gradients(
    parameters: Parameters, bodies: Tensor, view: _View, contexts: tuple[native.Context, native.Context]
) -> dict[str, Tensor]:
    """Compute the gradients of the loss of an image, by name; `contexts` belong to rasterizer and loss."""
    leaves = parameters.leaves()
    Ts_world_body = torch.tensor(view.Ts_world_body, dtype=torch.float32)
    drawn = CpuRasterizer(contexts[0])(
        GaussianTensors(**{**leaves, "sh": _harmonics(leaves["sh"], view)}),
        view.camera,
        RasterOptions(sh_degree=int(np.sqrt(leaves["sh"].shape[1])) - 1),
        parts=PartTensors(indices=bodies, Ts_world_part=Ts_world_body),
    )
    target = torch.tensor(np.ascontiguousarray(view.image_srgb.transpose(2, 0, 1))).float() / 255
    rgb = drawn.rgb
    if view.shade is not None:
        rgb = rgb * torch.tensor(np.ascontiguousarray(view.shade.transpose(2, 0, 1)))
    if view.unsure is not None:
        target = torch.where(torch.tensor(view.unsure), rgb.detach(), target)
    image_loss(rgb, target, context=contexts[1]).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def _harmonics(learned: Tensor, view: _View) -> Tensor:
    """Compute harmonics (N, K, 3); the last M are relit colors plus a share of the fitted difference."""
    constant = torch.tensor((view.colors_srgb - 0.5) / SH_C0, dtype=torch.float32)
    recall = torch.tensor(view.recall, dtype=torch.float32)
    first = len(learned) - len(recall)
    lit = constant + recall[:, None] * learned[first:, 0]
    constants = torch.cat([learned[:first, 0], lit])
    return torch.cat([constants[:, None], learned[:, 1:]], 1)
