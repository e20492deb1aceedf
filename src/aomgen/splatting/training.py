"""Gaussians fitted to posed images: one loop, counted in iterations."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.splatting import native
from aomgen.splatting.checkpoint import (
    Checkpoint,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
    training_digest,
)
from aomgen.splatting.compute import Compute, NativeCompute, make_compute
from aomgen.splatting.differentiable import GaussianTensors, RasterOptions
from aomgen.splatting.optimizer import (
    RATES,
    Parameters,
    error_shares,
    gaussians_of,
    parameter_rates,
    parameters_of,
    relocate_and_grow,
)
from aomgen.splatting.surfaces import in_free_space, view_depths
from aomgen.splatting.training_views import (
    Exposure,
    PoseIncrements,
    TrainingView,
    clip_to_sensor,
    reduce_image,
)

# Shares of the iterations at which degrees 1, 2, 3 are switched on: constant colors settle first.
SH_STARTS = (0.0, 0.2, 0.4)
# Weight of the mean opacity in the loss: Gaussians that no image needs fade and are relocated.
OPACITY_WEIGHT = 0.002
# Final factor on the means' learning rate: they converge, as in 3DGS.
MEANS_DECAY = 0.02
# Final factor on all other learning rates.
DECAY = 0.3
# Shares of the iterations between which Gaussians are relocated and added: not before there is something to
# see, and with time left to settle.
GROW_WINDOW = (0.1, 0.75)
# Shares from which on, at the next relocation, Gaussians in free space are dropped once.
CLEAR_AT = (0.45, 0.65)
# Images of which the error is looked at for a relocation: as many as take a tenth of its time.
ERROR_VIEWS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingParams:
    """Length, learning rates and growth of a training. Lengths are shares of the scene's extent.

    Attributes:
        iterations: Images rendered and fitted to, in total.
        sh_degree: Highest degree of the result, 0..3.
        downsampling: (share of the iterations, factor): from that share on, images are reduced
            by the factor.
        max_gaussians: Never more than these.
        grow_every: Iterations between relocations.
        min_opacity: Fainter Gaussians are relocated.
        background: sRGB behind everything; None draws a random color every iteration.
        rates: Learning rates at the start, see `RATES`; means and poses fall by `MEANS_DECAY` until the
            end, the others by `DECAY`.
        exposure: Fit a gain for every color of every image (the product is kept at 1).
        refine_poses: Correct the poses of the training cameras, see `PoseIncrements`.
        refine_from: Share of the iterations before which poses stay: a scene that is not there yet pulls at them.
    """

    iterations: int = 1800
    sh_degree: int = 2
    downsampling: tuple[tuple[float, int], ...] = ((0.0, 4), (0.1, 2), (0.35, 1))
    max_gaussians: int = 100_000
    grow_every: int = 100
    min_opacity: float = 0.01
    background: tuple[float, float, float] | None = None
    rates: Mapping[str, float] = field(default_factory=lambda: RATES)
    exposure: bool = True
    refine_poses: bool = False
    refine_from: float = 0.15


def train(
    initial: Gaussians,
    cameras: list[Camera],
    images: list[NDArray[np.uint8]],
    params: TrainingParams,
    progress: Progress,
    rng: np.random.Generator,
    *,
    checkpoint: Checkpoint | None = None,
    device: str = "cpu",
) -> Gaussians:
    """Fit Gaussians to images; the same inputs and generator give the same result on one machine.

    Args:
        initial: Initial Gaussians, in the frame of the cameras; its SH degree is raised to the
            result's.
        cameras: One for every image, at the image's size.
        images: (H, W, 3) uint8 sRGB.
        params: Length, rates, growth.
        progress: Called after every tenth iteration.
        rng: Order of the images, background colors and choice of Gaussians to split.
        checkpoint: File of the state. If it exists, the training continues from
            it, to the same result bit by bit; it is left behind when the training is done.
        device: "cpu", or "cuda" for gsplat, whose results repeat but for rounding.

    Raises:
        BackendError: The splatting engine is missing or refuses the scene.
        CorruptArtifactError: The checkpoint is damaged or belongs to another training.
        StorageError: The disk refuses the checkpoint.
        ValueError: No images, or images that do not fit their cameras.
    """
    _check(initial, cameras, images)
    digest = training_digest(initial, cameras, images, params, rng) if checkpoint else ""
    if checkpoint and checkpoint.path.exists():
        state = load_checkpoint(checkpoint.path, digest, rng)
    else:
        state = start_training(initial, cameras, params, rng)
    extent, compute = scene_extent(initial, cameras), make_compute(device)
    state.parameters = state.parameters.move(device)
    for loss in learning(state, cameras, images, params, extent, compute):
        done = state.iteration
        if checkpoint and (done % checkpoint.every == 0 or done == params.iterations):
            save_checkpoint(checkpoint.path, state, digest)
        if done % 10 == 0:
            text = f"{len(state.parameters)} Gaussians, loss {loss:.4f}"
            progress(done / params.iterations, text)
    return finish_training(state, params)


def start_training(
    initial: Gaussians, cameras: list[Camera], params: TrainingParams, rng: np.random.Generator
) -> TrainingState:
    """The state before the first iteration."""
    extent = scene_extent(initial, cameras)
    middle = np.median(initial.means, axis=0)
    reach = np.maximum(np.linalg.norm(initial.means - middle, axis=1) / extent, 1.0)
    return TrainingState(
        parameters=parameters_of(initial, params.sh_degree, reach),
        exposure=Exposure.neutral(len(cameras), params.exposure),
        poses=PoseIncrements.neutral(cameras, middle, extent, params.refine_poses),
        order=np.zeros(0, np.int64),
        rng=rng,
    )


def learning(
    state: TrainingState,
    cameras: list[Camera],
    images: list[NDArray[np.uint8]],
    params: TrainingParams,
    extent: float,
    compute: Compute | None = None,
) -> Iterator[float]:
    """Advance a state, iteration by iteration, until the last; gives the loss of each.

    Between two iterations the state is whole: it may be looked at and saved. Steps are measured in `extent`,
    `scene_extent` of the start; the state's Gaussians are on the device of `compute`, by default the engine's.
    """
    compute, context = compute or NativeCompute(), native.Context(threads=1)
    views: list[TrainingView] = []
    factor = 0
    with one_torch_thread():
        while state.iteration < params.iterations:
            share = state.iteration / params.iterations
            if factor != _factor(params, share):
                factor = _factor(params, share)
                views = [
                    reduce_image(camera, image, factor).move(compute.device)
                    for camera, image in zip(cameras, images, strict=True)
                ]
            if not len(state.order):
                state.order = state.rng.permutation(len(views))
            index, state.order = int(state.order[0]), state.order[1:]
            loss = _learn(state, views[index], index, params, extent, (compute, context))
            if _grows(params, state.iteration):
                state.parameters = _grow(state, views, params)
            state.iteration += 1
            yield loss


def finish_training(state: TrainingState, params: TrainingParams) -> Gaussians:
    """The Gaussians of a state without those that are hardly there."""
    trained = gaussians_of(state.parameters)
    return trained.select(np.isfinite(trained.means).all(1) & (trained.opacities >= params.min_opacity))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """The engine has its own threads; torch's would wait for each other by spinning on its cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def scene_extent(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Length that steps are measured in: median distance from a camera to the middle of the Gaussians."""
    middle = np.median(gaussians.means, axis=0)
    return float(np.median([np.linalg.norm(camera.center - middle) for camera in cameras]))


def _learn(
    state: TrainingState,
    view: TrainingView,
    index: int,
    params: TrainingParams,
    extent: float,
    computes: tuple[Compute, native.Context],
) -> float:
    """One iteration; returns the loss. The few numbers of an image are fitted on the processor."""
    compute, context = computes
    parameters, exposure = state.parameters, state.exposure
    share = state.iteration / params.iterations
    leaves = parameters.leaves()
    background = params.background or tuple(state.rng.random(3).tolist())
    options = RasterOptions(sh_degree=_sh_degree(params, share), background=background)
    twist = state.poses.leaf(index)
    T_cam_world = None if twist is None else state.poses.T_cam_world(view.camera, twist)
    drawn = compute.draw(GaussianTensors(**leaves), view.camera, options, T_cam_world=T_cam_world)
    log_gains = exposure.leaf(index)
    gains = None if log_gains is None else log_gains.exp().to(compute.device)
    target = view.target()
    seen = clip_to_sensor(drawn.rgb, target, gains)
    loss = compute.image_loss(seen, target, gains=gains)
    total = loss + OPACITY_WEIGHT * leaves["logit_opacities"].sigmoid().mean()
    total.backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    means = params.rates["means"] * extent * MEANS_DECAY**share
    rates = parameter_rates(params.rates, means, DECAY**share, params.sh_degree)
    rates = {name: rate.to(compute.device) for name, rate in rates.items()}
    parameters.step(gradients, rates, compute)
    if log_gains is not None and log_gains.grad is not None:
        exposure.step(index, log_gains.grad, params.rates["gain"], context)
    if twist is not None and twist.grad is not None and share >= params.refine_from:
        state.poses.step(index, twist.grad, params.rates["poses"] * MEANS_DECAY**share, context)
    return float(loss.detach())


def _grow(state: TrainingState, views: list[TrainingView], params: TrainingParams) -> Parameters:
    """Relocate faint Gaussians and approach the maximum number towards the end of the window."""
    parameters, exposure = state.parameters, state.exposure
    share = state.iteration / params.iterations
    chosen = choose_error_views(len(views), ERROR_VIEWS, state.iteration // params.grow_every)
    gains = exposure.values.exp()[:, :, None, None]
    targets = [(views[i].target().cpu() / gains[i]).clamp(max=1).numpy() for i in chosen]
    gaussians = gaussians_of(parameters).with_sh_degree(_sh_degree(params, share))
    cameras = [state.poses.correct(i, views[i].camera) for i in chosen]
    shares = error_shares(gaussians, cameras, targets)
    left = max(1.0, (GROW_WINDOW[1] - share) * params.iterations / params.grow_every)
    count = max(
        len(parameters), round(len(parameters) * (params.max_gaussians / len(parameters)) ** (1 / left))
    )
    dropped = None
    if _clears(params, state.iteration):
        everywhere = [state.poses.correct(i, view.camera) for i, view in enumerate(views)]
        dropped = in_free_space(gaussians.means.astype(np.float64), view_depths(gaussians, everywhere))
    count = min(count, params.max_gaussians)
    grown, _ = relocate_and_grow(parameters, shares, count, params.min_opacity, state.rng, dropped)
    return grown


def choose_error_views(views: int, count: int, turn: int) -> NDArray[np.int64]:
    """Views spread evenly over the scan; the next turn takes their neighbours, until all had one."""
    count = min(count, views)
    return np.unique((np.arange(count) * views // count + turn) % views)


def _grows(params: TrainingParams, iteration: int) -> bool:
    first, last = (round(share * params.iterations) for share in GROW_WINDOW)
    return first <= iteration < last and iteration % params.grow_every == params.grow_every - 1


def _clears(params: TrainingParams, iteration: int) -> bool:
    starts = [round(share * params.iterations) for share in CLEAR_AT]
    return any(start <= iteration < start + params.grow_every for start in starts)


def _factor(params: TrainingParams, share: float) -> int:
    return next(factor for start, factor in reversed(params.downsampling) if share >= start)


def _sh_degree(params: TrainingParams, share: float) -> int:
    return min(params.sh_degree, sum(share >= start for start in SH_STARTS))


def _check(initial: Gaussians, cameras: list[Camera], images: list[NDArray[np.uint8]]) -> None:
    if not len(initial) or not images or len(cameras) != len(images):
        raise ValueError(f"{len(initial)} Gaussians, {len(cameras)} cameras and {len(images)} images")
    for camera, image in zip(cameras, images, strict=True):
        if image.shape != (camera.height, camera.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"an image is {image.shape} {image.dtype}, its camera {camera.width}x{camera.height}"
            )
