"""Times of the engine and of gsplat on one scene, and the difference of their images.

    python -m benchmarks.gsplat_times 20000,100000,300000 640x480

Wall times, medians: the engine with all processors, gsplat synchronized with the GPU.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.compute import make_rasterizer
from aomgen.splatting.differentiable import GaussianTensors, Rasterizer, RasterOptions
from benchmarks.scenes import table_camera, table_top

OPTIONS = RasterOptions(sh_degree=3)
COLUMNS = ("Gaussians", "forward", "with ids", "with 16 features", "forward+backward", "PSNR [dB]")


def tensors(gaussians: Gaussians, device: str) -> GaussianTensors:
    """Convert parameters to those of the optimizer, on a device, with gradients."""
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-6, 1 - 1e-6)

    def leaf(array: np.ndarray) -> Tensor:
        return torch.tensor(np.asarray(array, np.float32), device=device).requires_grad_()

    return GaussianTensors(
        means=leaf(gaussians.means),
        quats=leaf(gaussians.quats),
        log_scales=leaf(np.log(gaussians.scales)),
        logit_opacities=leaf(np.log(opacities / (1 - opacities))),
        sh=leaf(gaussians.sh),
    )


def passes(draw: Rasterizer, gaussians: GaussianTensors, camera: Camera) -> dict[str, Callable[[], Tensor]]:
    """Return the timed operations, by column."""
    shape = (len(gaussians.means), 16)
    featured = replace(gaussians, features=torch.ones(shape, device=gaussians.means.device))
    with_ids = replace(OPTIONS, with_ids=True)
    leaves = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)

    def training() -> Tensor:
        drawn = draw(gaussians, camera, OPTIONS)
        (drawn.rgb.square().mean() + drawn.depth.mean() + drawn.alpha.mean()).backward()
        for leaf in leaves:
            leaf.grad = None
        return drawn.rgb

    return {
        "forward": torch.no_grad()(lambda: draw(gaussians, camera, OPTIONS).rgb),
        "with ids": torch.no_grad()(lambda: draw(gaussians, camera, with_ids).rgb),
        "with 16 features": torch.no_grad()(lambda: draw(featured, camera, OPTIONS).rgb),
        "forward+backward": training,
    }


def median_ms(function: Callable[[], Tensor], repeats: int = 15) -> float:
    """Measure the median wall time after two unmeasured calls, [ms]."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        if function().device.type == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times[2:]))


def rows_of(count: int, size: tuple[int, int], rasterizers: dict[str, tuple[Rasterizer, str]]) -> list[list]:
    """Make one row of the table for every rasterizer; the images are compared with the first one's."""
    scene, camera = table_top(count, 3), table_camera(*size)
    rows, pictures = [], []
    for name, (draw, device) in rasterizers.items():
        functions = passes(draw, tensors(scene, device), camera)
        pictures.append(functions["forward"]().detach().cpu().clamp_max(1))
        error = (pictures[-1] - pictures[0]).square().mean()
        figures = [f"{median_ms(function):.2f} ms" for function in functions.values()]
        rows.append([name, count, *figures, f"{-10 * error.log10():.1f}" if error > 0 else ""])
    return rows


def main() -> None:
    counts = [int(text) for text in sys.argv[1].split(",")]
    width, height = (int(text) for text in sys.argv[2].split("x"))
    gpu = torch.cuda.get_device_name()
    print(
        f"\n{gpu}, torch {torch.__version__}, {torch.get_num_threads()} torch threads, {width} x {height}, SH 3"
    )
    print("| rasterizer | " + " | ".join(COLUMNS) + " |\n" + "|---" * (len(COLUMNS) + 1) + "|")
    rasterizers = {"engine": (make_rasterizer("cpu"), "cpu"), "gsplat": (make_rasterizer("cuda"), "cuda")}
    for count in counts:
        for row in rows_of(count, (width, height), rasterizers):
            print("| " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    main()
