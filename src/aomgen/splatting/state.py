"""Everything a training changes, and its way into named arrays and back."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.splatting.optimizer import NAMES, Parameters
from aomgen.splatting.poses import PoseIncrements
from aomgen.splatting.training_views import Exposure

MOMENTS = ("values", "averages", "squares")
EXPOSURE = ("log_gains", "averages", "squares", "steps")
POSES = ("twists", "averages", "squares", "steps", "gauge", "to_middle")


@dataclass(slots=True, kw_only=True)
class TrainingState:
    """Where a training stands; from here on everything is determined by images and parameters.

    Attributes:
        parameters: Gaussians with their optimizer state.
        exposure: Gains of the images with their optimizer state.
        poses: Corrections of the cameras with their optimizer state.
        order: Indices of the images still to be drawn before the next shuffle.
        iteration: Iterations done.
        rng: Source of everything random.
    """

    parameters: Parameters
    exposure: Exposure
    poses: PoseIncrements
    rng: np.random.Generator
    order: NDArray[np.int64]
    iteration: int = 0


def state_arrays(state: TrainingState) -> dict[str, NDArray]:
    """The whole state as named arrays, exact to the bit."""
    arrays = {
        f"{moment}.{name}": getattr(state.parameters, moment)[name].cpu().numpy()
        for moment in MOMENTS
        for name in NAMES
    }
    arrays["reach"] = state.parameters.reach.cpu().numpy()
    arrays |= {f"exposure.{name}": getattr(state.exposure, name).numpy() for name in EXPOSURE}
    arrays |= {f"poses.{name}": getattr(state.poses, name).numpy() for name in POSES}
    counters = {
        "iteration": state.iteration,
        "steps": state.parameters.steps,
        "exposure": state.exposure.enabled,
        "poses": state.poses.enabled,
        "rng": state.rng.bit_generator.state,
    }
    text = json.dumps(counters, default=np.ndarray.tolist)
    return arrays | {"order": state.order, "counters": np.frombuffer(text.encode(), np.uint8)}


def state_of_arrays(arrays: Mapping[str, NDArray], rng: np.random.Generator) -> TrainingState:
    """The state that `state_arrays` took apart; the generator is set to where it was.

    Raises:
        KeyError, TypeError, ValueError: Arrays are missing, or the generator is of another kind.
    """
    counters = json.loads(arrays["counters"].tobytes())
    moments = {moment: {name: _tensor(arrays[f"{moment}.{name}"]) for name in NAMES} for moment in MOMENTS}
    rng.bit_generator.state = counters["rng"]
    return TrainingState(
        parameters=Parameters(reach=_tensor(arrays["reach"]), steps=counters["steps"], **moments),
        exposure=Exposure(
            enabled=counters["exposure"], **{name: _tensor(arrays[f"exposure.{name}"]) for name in EXPOSURE}
        ),
        poses=PoseIncrements(
            enabled=counters["poses"], **{name: _tensor(arrays[f"poses.{name}"]) for name in POSES}
        ),
        order=np.array(arrays["order"]),
        iteration=counters["iteration"],
        rng=rng,
    )


def _tensor(array: NDArray) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array))
