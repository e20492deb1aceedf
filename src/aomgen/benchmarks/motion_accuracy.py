"""`aomgen bench accuracy --synthetic-motion N`: AOMotion on cheap worlds, the paper's method beside it."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.make import MAKERS
from aomgen.benchmarks.accuracy import score_motion
from aomgen.benchmarks.motion_worlds import CAMERA, MotionWorld, motion_world
from aomgen.core.motion import MotionEstimate
from aomgen.errors import EstimationError
from aomgen.motion.estimate import estimate_motion
from aomgen.pipeline.estimates import motion_estimates

# Seeds below are for looking at while working on the methods; a score wants unseen ones.
FIRST_SEED: Final = 2000
NORMAL_95: Final = 1.96


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One world and what a method made of it.

    Attributes:
        world, category: Which.
        joint_type: The true one.
        method: "ours" or "paper".
        refusal: Name of the error, empty when there is an answer.
        reason: Its sentence.
        figures: By dotted name; empty when refused.
        moving_share: Share of the film in which the part moves.
        seconds: Processor time of the estimate.
    """

    world: str
    category: str
    joint_type: str
    method: str
    refusal: str
    reason: str
    figures: dict[str, Any]
    moving_share: float
    seconds: float

    @property
    def failed(self) -> bool:
        """Whether there is no answer, or one with the wrong type of joint."""
        return bool(self.refusal) or not self.figures["joint.type_ok"]

    def error(self, name: str) -> float:
        """A figure; infinite where the method failed."""
        value = self.figures.get(name)
        return float("inf") if self.failed or value is None else float(value)

    def row(self) -> dict[str, Any]:
        """For tables and JSON."""
        return {
            "world": self.world,
            "method": self.method,
            "cpu_s": self.seconds,
            "moving_share": self.moving_share,
            "refusal": self.refusal,
            "reason": self.reason,
        } | self.figures


def run_motion(
    count: int, out: Path | None, tell: Callable[[Outcome], None], first_seed: int = FIRST_SEED
) -> list[Outcome]:
    """Make worlds, recover their motion, score it.

    Args:
        count: How many; categories take turns.
        out: Keeps the worlds, which are made but once; temporary when None.
        tell: Gets every outcome as soon as it is known.
        first_seed: Seed of the first world of each category, the others follow.
    """
    categories = sorted(MAKERS)
    outcomes = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = (out or Path(scratch)).resolve()
        for number in range(count):
            category, seed = categories[number % len(categories)], first_seed + number // len(categories)
            outcomes.append(judged(motion_world(category, seed, folder), category))
            tell(outcomes[-1])
    return outcomes


def judged(world: MotionWorld, category: str) -> Outcome:
    """Recover the motion of a world and score it."""
    truth, times = world.truth, world.demonstration.video.times_s
    began = time.process_time()
    refusal, reason, figures = "", "", {}
    try:
        estimate = estimate_motion(world.demonstration)
    except EstimationError as error:
        estimate, refusal, reason = None, type(error).__name__, str(error)
    seconds = time.process_time() - began
    if estimate is not None:
        figures = score_motion(motion_estimates(estimate), truth, times, CAMERA)
        figures |= intervals(estimate, world, figures)
    return Outcome(
        world=world.name,
        category=category,
        joint_type=truth.joint.type,
        method="ours",
        refusal=refusal,
        reason=reason,
        figures=figures,
        moving_share=(truth.end_frame - truth.start_frame + 1) / len(times),
        seconds=seconds,
    )


def intervals(estimate: MotionEstimate, world: MotionWorld, figures: dict[str, Any]) -> dict[str, Any]:
    """Half-widths of the 95 % intervals, and the share of truth within them: 0, 1, or of the frames."""
    truth = world.truth
    widths = {"axis_deg": np.degrees(estimate.axis_ci95_rad)}
    inside = {"axis": figures["joint.axis_deg"] <= widths["axis_deg"]}
    if figures.get("joint.origin_mm") is not None and estimate.joint.type == "revolute":
        widths["origin_mm"] = 1e3 * estimate.origin_ci95_m
        inside["origin"] = figures["joint.origin_mm"] <= widths["origin_mm"]
    if figures["joint.type_ok"]:
        moving = slice(truth.start_frame, truth.end_frame + 1)
        true = truth.theta[CAMERA] - truth.theta[CAMERA][0]
        unit, factor = ("deg", 180 / np.pi) if truth.joint.type == "revolute" else ("mm", 1e3)
        half = NORMAL_95 * estimate.theta_sd[moving]
        errors = np.abs(estimate.thetas - estimate.thetas[0] - true)[moving]
        widths[f"theta_{unit}"] = factor * float(np.median(half))
        inside["theta"] = float(np.mean(errors <= half))
    return {f"half_width.{name}": float(value) for name, value in widths.items()} | {
        f"inside.{name}": float(value) for name, value in inside.items()
    }
