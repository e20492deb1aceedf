"""Gaussians as the optimizer holds them: logs, logits and running averages of their gradients."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.gaussians import Gaussians
from aomgen.splatting.compute import Compute

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")
# Keeps logarithms finite; far below any real scale, [m].
MIN_SCALE = 1e-9


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

    def moved(self, device: str) -> "Parameters":
        """The same parameters on a device."""

        def on_device(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
            return {name: tensor.to(device) for name, tensor in tensors.items()}

        return Parameters(
            values=on_device(self.values),
            averages=on_device(self.averages),
            squares=on_device(self.squares),
            reach=self.reach.to(device),
            steps=self.steps,
        )

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

    def rebuilt(self, kept: Tensor, parents: Tensor, added: dict[str, Tensor]) -> "Parameters":
        """The rows `kept` (indices) followed by new rows, whose gradient averages start at zero.

        Args:
            kept: Indices of rows that stay.
            parents: Index of the row that each new row came from.
            added: New rows.
        """
        rest = {name: torch.zeros_like(value) for name, value in added.items()}
        return Parameters(
            values={name: torch.cat([self.values[name][kept], added[name]]) for name in NAMES},
            averages={name: torch.cat([self.averages[name][kept], rest[name]]) for name in NAMES},
            squares={name: torch.cat([self.squares[name][kept], rest[name]]) for name in NAMES},
            reach=self.reach[torch.cat([kept, parents])],
            steps=self.steps,
        )


def parameters_of(
    gaussians: Gaussians, sh_degree: int, reach: NDArray[np.float64] | None = None
) -> Parameters:
    """Parameters that start at the given Gaussians, with room for SH up to a degree.

    Args:
        gaussians: N Gaussians.
        sh_degree: 0..3.
        reach: See `Parameters`; ones by default.
    """
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
    parameters = parameters.moved("cpu")
    values = parameters.values
    return Gaussians(
        means=values["means"].numpy(),
        quats=torch.nn.functional.normalize(values["quats"], dim=-1).numpy(),
        scales=values["log_scales"].exp().numpy(),
        opacities=parameters.opacities().numpy(),
        sh=values["sh"].numpy(),
    )
