"""Training of Gaussians from posed images."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.errors import ConfigError
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

# Shares of the iterations at which SH degrees 1, 2 and 3 are switched on; later starts let lower degrees converge first.
SH_STARTS = (0.0, 0.2, 0.4)
# Weight of the mean opacity in the loss; it makes Gaussians that no image needs fade, so that they are relocated.
OPACITY_WEIGHT = 0.002
# Final factor on the learning rate of the means, which lets them converge, as in 3DGS.
MEANS_DECAY = 0.02
# Final factor on all other learning rates.
DECAY = 0.3
# Shares of the iterations between which Gaussians are relocated and added. Earlier, the errors of the images do not yet
# indicate missing detail; later, new Gaussians would not converge.
GROW_WINDOW = (0.1, 0.75)
# Shares of the iterations; at the next relocation after each of them, Gaussians in free space are removed.
CLEAR_AT = (0.45, 0.65)
# Number of images whose errors a relocation evaluates.
ERROR_VIEWS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingParams:
    """Parameters of a training.

    Attributes:
        iterations: Number of iterations; each renders one image.
        sh_degree: SH degree of the result, 0..3.
        downsampling: Pairs (share of the iterations, factor) by increasing share, the first one 0: from this share on, the
            sides of images are divided by the factor.
        max_gaussians: Limit of the number of Gaussians.
        grow_every: Iterations between relocations.
        min_opacity: Gaussians of lower opacity are relocated, and removed from the result.
        background: sRGB color 0..1 behind the Gaussians; None samples a random color in each iteration.
        rates: Initial learning rates, see `RATES`. Those of means and poses decrease by the factor `MEANS_DECAY` until the
            end, those of Gaussians' other parameters by `DECAY`.
        exposure: Fit a gain for each color channel of each image, with a geometric mean of 1 over the images.
        refine_poses: Correct the poses of the training cameras; see `PoseIncrements`.
        refine_from: Share of the iterations before which poses are not corrected, because the errors of an incomplete scene
            would change them.
    """

    iterations: int = 1800
    sh_degree: int = 2
    downsampling: tuple[tuple[float, int], ...] = ((0.0, 4), (0.15, 2), (0.5, 1))
    max_gaussians: int = 100_000
    grow_every: int = 100
    min_opacity: float = 0.01
    background: tuple[float, float, float] | None = None
    rates: Mapping[str, float] = field(default_factory=lambda: RATES)
    exposure: bool = True
    refine_poses: bool = False
    refine_from: float = 0.15

    def __post_init__(self) -> None:
        shares = [share for share, _ in self.downsampling]
        if (
            shares[:1] != [0.0]
            or shares != sorted(shares)
            or any(factor < 1 for _, factor in self.downsampling)
        ):
            raise ConfigError(
                "parameter 'gaussians.training.downsampling'",
                f"is {self.downsampling}",
                "use pairs of a share, beginning with 0, and a factor of at least 1, e.g. [[0.0, 2], [0.3, 1]]",
            )


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
    """Fit Gaussians to images; on a CPU, equal inputs and generator states give equal results on one machine.

    Args:
        initial: Initial Gaussians, in the frame of the cameras; their SH degree is changed to `params.sh_degree`. If there are
            more than `params.max_gaussians`, a part of them is used.
        cameras: Camera of each image, at the size of the image.
        images: Images (H, W, 3) uint8, sRGB.
        params: Parameters of the training.
        progress: Called after every tenth iteration.
        rng: Random generator for the order of the images, background colors and the choice of Gaussians to split.
        checkpoint: File for the state of the training. If it exists, the training continues from it with a bitwise equal
            result. The file remains after the training.
        device: "cpu", or "cuda" for gsplat, whose results are reproducible up to rounding.

    Returns:
        Trained Gaussians, in the frame of the cameras.

    Raises:
        BackendError: The splatting engine is missing or refuses the scene.
        LimitExceededError, CorruptArtifactError: The checkpoint is too large, damaged or belongs to another training.
        StorageError: The checkpoint cannot be written.
        ValueError: There are no Gaussians or images, or images do not match their cameras.
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
    """Create the state before the first iteration; see `train` for the arguments."""
    extent = scene_extent(initial, cameras)
    middle = np.median(initial.means, axis=0)
    gaussians = limit_number(initial, params.max_gaussians)
    reach = np.maximum(np.linalg.norm(gaussians.means - middle, axis=1) / extent, 1.0)
    return TrainingState(
        parameters=parameters_of(gaussians, params.sh_degree, reach),
        exposure=Exposure.neutral(len(cameras), params.exposure),
        poses=PoseIncrements.neutral(cameras, middle, extent, params.refine_poses),
        order=np.zeros(0, np.int64),
        rng=rng,
    )


def limit_number(gaussians: Gaussians, limit: int) -> Gaussians:
    """Select at most `limit` Gaussians, evenly in their order, and widen them so that they cover the same surfaces."""
    count = len(gaussians)
    if count <= limit:
        return gaussians
    kept = gaussians.select(np.arange(limit) * count // limit)
    return replace(kept, scales=kept.scales * np.sqrt(count / limit))


def learning(
    state: TrainingState,
    cameras: list[Camera],
    images: list[NDArray[np.uint8]],
    params: TrainingParams,
    extent: float,
    compute: Compute | None = None,
) -> Iterator[float]:
    """Run the remaining iterations of a training and yield the loss of each.

    Whenever a loss is yielded, the state is consistent, so that the caller may read and save it.

    Args:
        state: State of the training, changed in place; its Gaussians are on the device of `compute`.
        cameras: Camera of each image.
        images: Images (H, W, 3) uint8, sRGB.
        params: Parameters of the training.
        extent: Unit of the steps of the means: `scene_extent` of the initial Gaussians.
        compute: Computations of the training; None uses the engine on the CPU.
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
    """Return the Gaussians of a state, without those that are not finite or fainter than `params.min_opacity`."""
    trained = gaussians_of(state.parameters)
    return trained.select(np.isfinite(trained.means).all(1) & (trained.opacities >= params.min_opacity))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to one thread, because its idle threads would busy-wait on the cores of the engine's threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def scene_extent(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Compute the unit of the steps of the means: the median distance from the cameras to the median of the Gaussians."""
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
    """Perform one iteration and return its loss; the parameters of the images are optimized on the CPU."""
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
    """Relocate faint Gaussians, and add some so that their number reaches the limit at the end of `GROW_WINDOW`."""
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
    """Choose `count` of the indices of `views` views, evenly distributed; each increment of `turn` shifts them by one."""
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
