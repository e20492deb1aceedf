"""Gaussians as the optimizer holds them: logs, logits and running averages of their gradients."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.splatting.compute import Compute
from aomgen.splatting.rasterizer import contribution_weights, render

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")
# Keeps logarithms finite; far below any real scale, [m].
MIN_SCALE = 1e-9
# A Gaussian of standard deviation s becomes two of SHRINK s at +-OFFSET s along its longest axis:
# the pair covers what the one did (SHRINK^2 + OFFSET^2 = 1) and is free to separate.
SHRINK, OFFSET = 0.8, 0.6
# Learning rates at the start of a training that is seeded from its images: of means and translations of the
# cameras in scene extents, of rotations in rad, of logarithms and of colors 0..1. Quaternions have no length.
RATES: Final[Mapping[str, float]] = {
    "means": 8e-4,
    "quats": 4e-3,
    "log_scales": 2.5e-2,
    "logit_opacities": 6e-2,
    "color": 2e-2,
    "sh": 5e-3,
    "gain": 2e-3,
    "poses": 1e-3,
}


@dataclass(slots=True, kw_only=True)
class Parameters:
    """Parameters of N Gaussians under optimization; the only mutable value of the training.

    Attributes:
        values: By name: means (N, 3), quats (N, 4) wxyz, log_scales (N, 3), logit_opacities
            (N,), sh (N, K, 3), all float32.
        averages: First moments of the gradients, same shapes.
        squares: Second moments.
        reach: (N,) factor on the steps of the means: a step moves far Gaussians as far in an
            image as near ones.
        steps: Optimizer steps taken.
    """

    values: dict[str, Tensor]
    averages: dict[str, Tensor]
    squares: dict[str, Tensor]
    reach: Tensor
    steps: int = 0

    def __len__(self) -> int:
        return len(self.values["means"])

    def move(self, device: str) -> "Parameters":
        """The same parameters on a device."""
        values, averages, squares = (
            {name: tensor.to(device) for name, tensor in tensors.items()}
            for tensors in (self.values, self.averages, self.squares)
        )
        reach = self.reach.to(device)
        return Parameters(values=values, averages=averages, squares=squares, reach=reach, steps=self.steps)

    def opacities(self) -> Tensor:
        """(N,), 0..1."""
        return self.values["logit_opacities"].sigmoid()

    def leaves(self) -> dict[str, Tensor]:
        """Views of the values that collect gradients."""
        return {name: value.detach().requires_grad_() for name, value in self.values.items()}

    def step(self, gradients: dict[str, Tensor], rates: dict[str, Tensor], compute: Compute) -> None:
        """Adam in place; `rates` has one learning rate for every column of a parameter."""
        self.steps += 1
        means = self.values["means"].clone()
        for name in NAMES:
            moments = self.averages[name], self.squares[name]
            compute.adam_step(self.values[name], gradients[name], moments, rates[name], self.steps)
        torch.lerp(means, self.values["means"], self.reach[:, None], out=self.values["means"])

    def rebuild(self, kept: Tensor, parents: Tensor, added: dict[str, Tensor]) -> "Parameters":
        """The rows `kept` (indices) followed by new rows of these parents, whose gradient averages start at zero."""
        rest = {name: torch.zeros_like(value) for name, value in added.items()}
        values, averages, squares = (
            {name: torch.cat([tensors[name][kept], new[name]]) for name in NAMES}
            for tensors, new in ((self.values, added), (self.averages, rest), (self.squares, rest))
        )
        reach = self.reach[torch.cat([kept, parents])]
        return Parameters(values=values, averages=averages, squares=squares, reach=reach, steps=self.steps)


def parameter_rates(
    rates: Mapping[str, float], means: float, decay: float, sh_degree: int
) -> dict[str, Tensor]:
    """A learning rate for every column of every parameter: `means` for these, else `rates` times `decay`."""
    by_coefficient = [rates["color"]] + [rates["sh"]] * ((sh_degree + 1) ** 2 - 1)
    return {
        "means": torch.full((3,), means),
        "quats": torch.full((4,), rates["quats"] * decay),
        "log_scales": torch.full((3,), rates["log_scales"] * decay),
        "logit_opacities": torch.full((1,), rates["logit_opacities"] * decay),
        "sh": torch.tensor(by_coefficient).repeat_interleave(3) * decay,
    }


def parameters_of(
    gaussians: Gaussians, sh_degree: int, reach: NDArray[np.float64] | None = None
) -> Parameters:
    """Parameters that start at the given Gaussians, with room for SH up to a degree 0..3; `reach` is ones by default."""
    padded = gaussians.with_sh_degree(sh_degree)
    opacities = np.clip(padded.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    arrays = {
        "means": padded.means,
        "quats": padded.quats,
        "log_scales": np.log(np.maximum(padded.scales, MIN_SCALE)),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh": padded.sh,
    }
    values = {name: torch.tensor(np.ascontiguousarray(a, np.float32)) for name, a in arrays.items()}
    return Parameters(
        values=values,
        averages={name: torch.zeros_like(value) for name, value in values.items()},
        squares={name: torch.zeros_like(value) for name, value in values.items()},
        reach=torch.ones(len(gaussians)) if reach is None else torch.tensor(reach, dtype=torch.float32),
    )


def gaussians_of(parameters: Parameters) -> Gaussians:
    """Real values of the parameters."""
    parameters = parameters.move("cpu")
    values = parameters.values
    return Gaussians(
        means=values["means"].numpy(),
        quats=torch.nn.functional.normalize(values["quats"], dim=-1).numpy(),
        scales=values["log_scales"].exp().numpy(),
        opacities=parameters.opacities().numpy(),
        sh=values["sh"].numpy(),
    )


def error_shares(gaussians: Gaussians, cameras: list[Camera], images: list[np.ndarray]) -> np.ndarray:
    """Share of each Gaussian (N,) in the absolute error of images, planar (3, H, W) sRGB 0..1."""
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
) -> tuple[Parameters, NDArray[np.int64]]:
    """Drop faint and unwanted Gaussians and split others, until there are `count`; and the row that each comes from.

    Parents are drawn with a probability proportional to their share of the error. A lower
    `count` than what is left after dropping adds nothing.

    Args:
        shares: Error by each, (N,), see `error_shares`.
        min_opacity: Fainter ones are dropped.
        dropped: Gaussians (N,) to drop however opaque they are.

    Source: relocation within a fixed budget follows Kheradmand et al., "3D Gaussian splatting as
    Markov chain Monte Carlo", 2024; drawing by error and splitting the longest axis are ours.
    """
    alive = (parameters.opacities() >= min_opacity).cpu().numpy()
    alive &= True if dropped is None else ~dropped
    weights = np.where(alive, shares, 0.0)
    wanted = min(count - int(alive.sum()), int((weights > 0).sum()))
    if wanted <= 0:
        nothing, kept = torch.zeros(0, dtype=torch.int64), np.flatnonzero(alive)
        return parameters.rebuild(torch.tensor(kept), nothing, _rows(parameters, nothing)), kept
    drawn = rng.choice(len(parameters), wanted, replace=False, p=weights / weights.sum())
    alive[drawn] = False
    parents = torch.tensor(drawn)
    halves, kept = _halves(_rows(parameters, parents)), np.flatnonzero(alive)
    grown = parameters.rebuild(torch.tensor(kept), parents.repeat(2), halves)
    return grown, np.concatenate([kept, drawn, drawn])


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
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, 1).gather(2, column[:, None, None].expand(-1, 3, 1))[..., 0]
