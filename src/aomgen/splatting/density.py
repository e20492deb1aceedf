"""Where Gaussians are added and taken away during training, within a fixed number."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.optimizer import NAMES, Parameters
from aomgen.splatting.rasterizer import contribution_weights, render

# A Gaussian of standard deviation s becomes two of SHRINK s at +-OFFSET s along its longest axis:
# the pair covers what the one did (SHRINK^2 + OFFSET^2 = 1) and is free to separate.
SHRINK, OFFSET = 0.8, 0.6


def error_shares(gaussians: Gaussians, cameras: list[Camera], images: list[np.ndarray]) -> np.ndarray:
    """How much of the images' absolute error each Gaussian paints, (N,) float64.

    Args:
        gaussians: What is drawn.
        cameras: One for every image, at the image's size.
        images: Planar (3, H, W) float32 sRGB 0..1.
    """
    shares = np.zeros(len(gaussians))
    for camera, image in zip(cameras, images, strict=True):
        error = np.abs(render(gaussians, camera).rgb - image.transpose(1, 2, 0)).mean(-1)
        shares += contribution_weights(gaussians, camera, error[None])[:, 0]
    return shares


def relocate_and_grow(
    parameters: Parameters,
    shares: np.ndarray,
    count: int,
    min_opacity: float,
    rng: np.random.Generator,
    dropped: NDArray[np.bool_] | None = None,
) -> Parameters:
    """Drop faint and unwanted Gaussians and split others, until there are `count`.

    Parents are drawn with a probability proportional to their share of the error. A lower
    `count` than what is left after dropping adds nothing.

    Args:
        parameters: N Gaussians under optimization.
        shares: Error painted by each, (N,).
        count: Number of Gaussians wanted.
        min_opacity: Fainter ones are dropped.
        rng: Source of the draw.
        dropped: Gaussians (N,) to drop however opaque they are.

    Source: relocation within a fixed budget follows Kheradmand et al., "3D Gaussian splatting as
    Markov chain Monte Carlo", 2024; drawing by error and splitting the longest axis are ours.
    """
    alive = (parameters.opacities() >= min_opacity).cpu().numpy()
    if dropped is not None:
        alive &= ~dropped
    weights = np.where(alive, shares, 0.0)
    wanted = min(count - int(alive.sum()), int((weights > 0).sum()))
    if wanted <= 0:
        nothing = torch.zeros(0, dtype=torch.int64)
        return parameters.rebuilt(torch.tensor(np.flatnonzero(alive)), nothing, _rows(parameters, nothing))
    drawn = rng.choice(len(parameters), wanted, replace=False, p=weights / weights.sum())
    alive[drawn] = False
    parents = torch.tensor(drawn)
    halves = _halves(_rows(parameters, parents))
    return parameters.rebuilt(torch.tensor(np.flatnonzero(alive)), parents.repeat(2), halves)


def _rows(parameters: Parameters, rows: Tensor) -> dict[str, Tensor]:
    return {name: parameters.values[name][rows] for name in NAMES}


def _halves(rows: dict[str, Tensor]) -> dict[str, Tensor]:
    """Both halves of every Gaussian, split along its longest axis."""
    longest = rows["log_scales"].argmax(1)
    pick = torch.arange(len(longest), device=longest.device)
    axis = rotation_columns(rows["quats"], longest) * rows["log_scales"][pick, longest].exp()[:, None]
    halves = {name: torch.cat([value, value]) for name, value in rows.items()}
    halves["means"] = torch.cat([rows["means"] + OFFSET * axis, rows["means"] - OFFSET * axis])
    log_scales = rows["log_scales"].clone()
    log_scales[pick, longest] += float(np.log(SHRINK))
    halves["log_scales"] = torch.cat([log_scales, log_scales])
    return halves


def rotation_columns(quats: Tensor, column: Tensor) -> Tensor:
    """Column (N,) 0..2 of each quaternion's rotation matrix, (N, 3)."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    columns = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
    return columns[torch.arange(len(quats), device=quats.device), column]
