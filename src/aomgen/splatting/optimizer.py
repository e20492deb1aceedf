"""Parameters of Gaussians under optimization: logarithms, logits and moments of the gradients; relocation of Gaussians."""

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
# Lower limit of scales, [m], far below any real one; it keeps logarithms finite.
MIN_SCALE = 1e-9
# A Gaussian of standard deviation s along its longest axis is split into two of SHRINK s at +-OFFSET s. Together they have
# the variance of the original (SHRINK^2 + OFFSET^2 = 1).
SHRINK, OFFSET = 0.8, 0.6
# Initial learning rates, for a training that starts from dense points. Units: scene extents for means and for translations of
# cameras, rad for rotations of cameras, and 1 for logarithms, logits, colors and (not normalized) quaternions.
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
    """Parameters of N Gaussians under optimization; `step` changes them in place.

    Attributes:
        values: Tensors by name: means (N, 3), quats (N, 4) wxyz, log_scales (N, 3), logit_opacities (N,), sh (N, K, 3), all
            float32.
        averages: First moments of the gradients, of the same shapes.
        squares: Second moments of the gradients, of the same shapes.
        reach: Factor (N,) on the steps of the means, larger for distant Gaussians, so that a step moves them in an image
            as far as near ones.
        steps: Number of completed optimizer steps.
    """

    values: dict[str, Tensor]
    averages: dict[str, Tensor]
    squares: dict[str, Tensor]
    reach: Tensor
    steps: int = 0

    def __len__(self) -> int:
        return len(self.values["means"])

    def move(self, device: str) -> "Parameters":
        """Copy the parameters to a device."""
        values, averages, squares = (
            {name: tensor.to(device) for name, tensor in tensors.items()}
            for tensors in (self.values, self.averages, self.squares)
        )
        reach = self.reach.to(device)
        return Parameters(values=values, averages=averages, squares=squares, reach=reach, steps=self.steps)

    def opacities(self) -> Tensor:
        """Compute the opacities (N,), 0..1."""
        return self.values["logit_opacities"].sigmoid()

    def leaves(self) -> dict[str, Tensor]:
        """Return views of the values that are leaves and collect gradients."""
        return {name: value.detach().requires_grad_() for name, value in self.values.items()}

    def step(self, gradients: dict[str, Tensor], rates: dict[str, Tensor], compute: Compute) -> None:
        """Perform a step of Adam in place; `rates` has one learning rate for each column of a parameter."""
        self.steps += 1
        means = self.values["means"].clone()
        for name in NAMES:
            moments = self.averages[name], self.squares[name]
            compute.adam_step(self.values[name], gradients[name], moments, rates[name], self.steps)
        torch.lerp(means, self.values["means"], self.reach[:, None], out=self.values["means"])

    def rebuild(self, kept: Tensor, parents: Tensor, added: dict[str, Tensor]) -> "Parameters":
        """Return the rows `kept` (indices) followed by new rows.

        Args:
            kept: Indices of the rows to keep.
            parents: Index of the parent of each new row, from which it inherits `reach`.
            added: Values of the new rows by name; their moments are zero.
        """
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
    """Return the learning rate of each column of each parameter: `means` for the means, `rates` times `decay` for others."""
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
    """Convert Gaussians to parameters with an SH degree of 0..3; `reach` (N,) is one by default."""
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
    """Convert parameters to Gaussians."""
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
    """Compute the contribution (N,) of each Gaussian to the absolute error of planar images (3, H, W), sRGB 0..1."""
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
    """Remove faint and marked Gaussians, and split others until there are `count`.

    The Gaussians to split are sampled with a probability proportional to their contribution to the error. If `count` or more
    remain after the removal, none is split.

    Args:
        parameters: N Gaussians.
        shares: Contribution of each to the error (N,); see `error_shares`.
        count: Number of Gaussians of the result. It is lower if too few Gaussians contribute to the error.
        min_opacity: Gaussians of lower opacity are removed.
        rng: Random generator of the sampling.
        dropped: Mask (N,) of Gaussians to remove regardless of their opacity.

    Returns:
        New parameters, and for each row the index in `parameters` from which it originates.

    Source: relocation within a fixed budget follows Kheradmand et al., "3D Gaussian splatting as Markov chain Monte Carlo",
    2024. Sampling by error and splitting along the longest axis are specific to AOMGen.
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
    """Split each of M Gaussians along its longest axis; rows i and i + M of the result come from Gaussian i."""
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
    """Compute one column (N, 3) of the rotation matrix of each quaternion (N, 4) wxyz; `column` (N,) is its index 0..2."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, 1).gather(2, column[:, None, None].expand(-1, 3, 1))[..., 0]
