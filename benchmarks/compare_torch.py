"""The engine and a tile rasterizer in plain torch, timed alternately on one thread."""

import time
from collections.abc import Callable

import numpy as np
import torch

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting import native
from benchmarks.agreement import draw
from benchmarks.projection import parameters_of
from benchmarks.timing import forward_pass, interleaved_ms, torch_threads, training_pass
from benchmarks.torch_tiles import render


def compare(gaussians: Gaussians, camera: Camera, rounds: int, tile_px: int) -> dict[str, float]:
    """Compute medians of both, medians of the ratios of each round, and the difference of the images."""
    context = native.Context(1)
    torch_forward, torch_training = _torch_passes(gaussians, camera, tile_px)
    functions = {
        "engine forward": forward_pass(gaussians, camera, context),
        "torch forward": torch_forward,
        "engine forward+backward": training_pass(gaussians, camera, native.Context(1)),
        "torch forward+backward": torch_training,
    }
    with torch_threads(1):
        times = interleaved_ms(functions, rounds, time.process_time)
    figures = {f"{name} [ms]": float(np.median(values)) for name, values in times.items()}
    for name in ("forward", "forward+backward"):
        ratios = times[f"torch {name}"] / times[f"engine {name}"]
        figures[f"ratio {name}"] = float(np.median(ratios))
    errors = np.abs(_difference(gaussians, camera, context, tile_px))
    figures["max difference of color and alpha"] = float(errors.max())
    figures["99.9th percentile"] = float(np.quantile(errors, 0.999))
    return figures


def _difference(gaussians: Gaussians, camera: Camera, context: native.Context, tile_px: int) -> np.ndarray:
    """Compute red, green, blue and alpha (4, H, W), engine minus torch."""
    parameters, degree = parameters_of(gaussians), gaussians.sh_degree
    with torch.no_grad():
        expected = render(parameters, camera, degree, tile_px=tile_px)
        drawn = draw(parameters, camera, degree, context)
    return (torch.cat([drawn.rgb, drawn.alpha[None]]) - expected[[0, 1, 2, 4]]).numpy()


def _torch_passes(
    gaussians: Gaussians, camera: Camera, tile_px: int
) -> tuple[Callable[[], None], Callable[[], None]]:
    parameters, degree = parameters_of(gaussians), gaussians.sh_degree
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    noise = np.random.default_rng(0).normal(size=(3, camera.height, camera.width))
    grad_rgb = torch.tensor(noise, dtype=torch.float32)

    def forward() -> None:
        with torch.no_grad():
            render(parameters, camera, degree, tile_px=tile_px)

    def training() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        render(leaves, camera, degree, tile_px=tile_px)[:3].backward(grad_rgb)

    return forward, training
