"""Passes of the engine as functions without arguments, and their times, measured alternately."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting import native
from aomgen.splatting.rasterizer import RigidParts, cam_from_parts, native_scene, native_view
from benchmarks.agreement import draw
from benchmarks.projection import parameters_of


def draw_planes(
    gaussians: Gaussians,
    camera: Camera,
    context: native.Context,
    planes: NDArray[np.float32],
    parts: RigidParts | None = None,
) -> None:
    """Draw red, green, blue, depth and alpha into planes (5, H, W)."""
    rgb, depth, alpha = (planes[index].ctypes.data for index in (0, 3, 4))
    images = native.Images(rgb=rgb, depth=depth, alpha=alpha)
    poses = cam_from_parts(camera, parts)
    context.forward(native_scene(gaussians, parts=parts), native_view(camera, poses), images)


def forward_pass(gaussians: Gaussians, camera: Camera, context: native.Context) -> Callable[[], None]:
    """Make a function that renders one frame: color, depth and alpha."""
    planes = np.empty((5, camera.height, camera.width), np.float32)
    return lambda: draw_planes(gaussians, camera, context, planes)


def gradient_pass(gaussians: Gaussians, camera: Camera, context: native.Context) -> Callable[[], None]:
    """Make a function that renders one frame and its gradients by all parameters, into the same arrays."""
    tensors = parameters_of(gaussians).values()
    names = ("means", "quats", "scales", "opacities", "sh")
    arrays = {name: tensor.numpy() for name, tensor in zip(names, tensors, strict=True)}
    results = {name: np.empty_like(array) for name, array in arrays.items()}
    planes = np.empty((5, camera.height, camera.width), np.float32)
    pull = np.random.default_rng(0).normal(size=(3, camera.height, camera.width)).astype(np.float32)

    def draw_and_differentiate() -> None:
        poses = cam_from_parts(camera)
        scene = native.NativeScene(
            count=len(gaussians),
            sh_coefficients=gaussians.sh.shape[1],
            sh_degree=gaussians.sh_degree,
            encoded=1,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        rgb, depth, alpha = (planes[index].ctypes.data for index in (0, 3, 4))
        images = native.Images(rgb=rgb, differentiable=1, depth=depth, alpha=alpha)
        context.forward(scene, native_view(camera, poses), images)
        gradients = native.SceneGradients(**{name: array.ctypes.data for name, array in results.items()})
        context.backward(native.ImageGradients(rgb=pull.ctypes.data), gradients, context.forward_number)

    return draw_and_differentiate


def training_pass(gaussians: Gaussians, camera: Camera, context: native.Context) -> Callable[[], None]:
    """Make a function like `gradient_pass`, through torch and into new tensors."""
    leaves = {name: tensor.requires_grad_() for name, tensor in parameters_of(gaussians).items()}
    noise = np.random.default_rng(0).normal(size=(3, camera.height, camera.width))
    grad_rgb = torch.tensor(noise, dtype=torch.float32)

    def draw_and_differentiate() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        draw(leaves, camera, gaussians.sh_degree, context).rgb.backward(grad_rgb)

    return draw_and_differentiate


def interleaved_ms(
    functions: dict[str, Callable[[], None]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:
    """Measure times (rounds,) of every function, [ms], once per round, after one round to warm up."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds + 1):
        for name, function in functions.items():
            start = clock()
            function()
            times[name].append(1e3 * (clock() - start))
    return {name: np.array(values[1:]) for name, values in times.items()}


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch's own operations on `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
