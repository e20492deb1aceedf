"""`python -m benchmarks accuracy --synthetic-motion N`: AOMotion on cheap unseen worlds."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.choice import MAKERS
from aomgen.core.motion import MotionEstimate
from aomgen.errors import ConfigError, EstimationError
from aomgen.io.artifact import read_json, read_npz
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.estimates_file import motion_estimates
from benchmarks.accuracy import score_motion
from benchmarks.motion_methods import REFUSAL, paper_estimates
from benchmarks.motion_worlds import (
    CAMERA,
    TRUE_ARRAYS,
    UNSOLVABLE,
    Kind,
    MotionWorld,
    motion_world,
)
from benchmarks.other_objects import OTHER_OBJECTS
from benchmarks.segmented import segmented

# Seeds below are for inspection during development; a score requires unseen ones.
FIRST_SEED: Final = 2000
NORMAL_95: Final = 1.96
# Number of unsolvable cases, and of worlds beyond an opening pinch, relative to solvable worlds.
UNSOLVABLE_SHARE: Final = 0.4
BEYOND_SHARE: Final = 0.2
# "open" uses objects beyond the five categories.
BEYOND: Final[tuple[Kind, ...]] = ("closing", "hook", "push", "open", "open")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Identity of a world: its category, seed and kind, and its group in the table."""

    category: str
    seed: int
    kind: Kind
    group: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One world and the result of a method.

    Attributes:
        case: The world.
        joint_type: The true joint type.
        method: "ours", or a variant of the paper's.
        refusal: Name of the error, empty when there is an estimate.
        reason: Message of the error.
        figures: Metrics by dotted name; empty when refused.
        moving_share: Share of the video in which the part moves.
        seconds: Processor time of the estimate.
    """

    case: Case
    joint_type: str
    method: str
    refusal: str
    reason: str
    figures: dict[str, Any]
    moving_share: float
    seconds: float

    @property
    def failed(self) -> bool:
        """Return whether there is no estimate, or one with the wrong type of joint."""
        return bool(self.refusal) or not self.figures["joint.type_ok"]

    @property
    def rightly_refused(self) -> bool:
        """Return whether an unsolvable world was refused with an error that states the reason."""
        return self.refusal in UNSOLVABLE.get(self.case.kind, ())

    def error(self, name: str) -> float:
        """Return a metric; infinite where the method failed."""
        value = self.figures.get(name)
        return float("inf") if self.failed or value is None else float(value)

    def row(self) -> dict[str, Any]:
        """Return a row for tables and JSON."""
        return {
            "world": self.case.category,
            "seed": self.case.seed,
            "kind": self.case.kind,
            "group": self.case.group,
            "method": self.method,
            "cpu_s": self.seconds,
            "moving_share": self.moving_share,
            "refusal": self.refusal,
            "reason": self.reason,
        } | self.figures


def cases(count: int, first_seed: int) -> list[Case]:
    """List worlds of the five categories, then unsolvable ones, then some beyond; categories alternate.

    Those beyond are other kinds of motion of the five categories, and other objects.
    """
    categories = sorted(MAKERS)
    groups: tuple[tuple[str, int, Sequence[Kind]], ...] = (
        ("solvable", count, ("open",)),
        ("unsolvable", round(UNSOLVABLE_SHARE * count), tuple(UNSOLVABLE)),
        ("beyond", round(BEYOND_SHARE * count), BEYOND),
    )
    result = []
    for group, number, kinds in groups:
        for k in range(number):
            # Kinds are shifted against categories, so that few cases contain many pairs.
            kind = kinds[(k + k // len(categories)) % len(kinds)]
            category = categories[k % len(categories)]
            if group == "beyond" and kind == "open":
                category = sorted(OTHER_OBJECTS)[k % len(OTHER_OBJECTS)]
            result.append(
                Case(category=category, seed=first_seed + k // len(categories), kind=kind, group=group)
            )
    return result


def run_motion(
    requested: Sequence[Case],
    out: Path | None,
    notify: Callable[[Outcome], None],
    skipped: Callable[[Case, str], None],
) -> list[Outcome]:
    """Make worlds, recover and score their motion.

    Args:
        requested: Requested worlds.
        out: Folder of the worlds, which are made only once; temporary when None.
        notify: Receives every outcome as soon as it is known.
        skipped: Receives every case without a demonstration, with the reason; it is left out.
    """
    outcomes = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = (out or Path(scratch)).resolve()
        for case in requested:
            try:
                world = motion_world(case.category, case.seed, folder, case.kind)
            except ConfigError as error:
                skipped(case, str(error))
                continue
            for outcome in judged(world, case):
                outcomes.append(outcome)
                notify(outcome)
    return outcomes


def judged(world: MotionWorld, case: Case) -> Iterator[Outcome]:
    """Recover the motion of a world and score it: ours, then the paper's variants where there is a motion.

    The paper's method is given true masks with a segmenter's errors, and the true joint type.
    """
    truth, times = world.truth, world.demonstration.video.times_s
    solvable = case.kind not in UNSOLVABLE
    blank = Outcome(
        case=case,
        joint_type=truth.joint.type,
        method="ours",
        refusal="",
        reason="",
        figures={},
        moving_share=(truth.end_frame - truth.start_frame + 1) / len(times) if solvable else 0.0,
        seconds=0.0,
    )
    began = time.process_time()
    try:
        estimate = estimate_motion(world.demonstration)
    except EstimationError as error:
        seconds = time.process_time() - began
        yield replace(blank, refusal=type(error).__name__, reason=str(error), seconds=seconds)
    else:
        seconds = time.process_time() - began
        figures = scored(estimate, world) if solvable else {"joint.type_ok": False}
        yield replace(blank, figures=figures, seconds=seconds)
    if case.group == "solvable":
        yield from _paper(world, blank)


def _paper(world: MotionWorld, blank: Outcome) -> Iterator[Outcome]:
    truth, times = world.truth, world.demonstration.video.times_s
    labels = read_npz(truth.folder / TRUE_ARRAYS)["film_labels"]
    began = time.process_time()
    masks = segmented(labels, np.random.default_rng(blank.case.seed))
    answers = paper_estimates(world.demonstration, masks, truth.joint.type)
    seconds = (time.process_time() - began) / len(answers)
    for name, answer in answers.items():
        refusal = "EstimationError" if REFUSAL in answer else ""
        figures = {} if refusal else score_motion(answer, truth, times, CAMERA)
        yield replace(
            blank,
            method=f"paper {name}",
            refusal=refusal,
            reason=answer.get(REFUSAL, ""),
            figures=figures,
            seconds=seconds,
        )


def scored(estimate: MotionEstimate, world: MotionWorld) -> dict[str, Any]:
    """Compute metrics of an estimate, its intervals, and whether it distinguishes opening from closing."""
    times = world.demonstration.video.times_s
    figures = score_motion(motion_estimates(estimate), world.truth, times, CAMERA)
    direction = read_json(world.truth.folder / "truth.json")["direction"]
    return figures | intervals(estimate, world, figures) | {"direction_ok": estimate.direction == direction}


def intervals(estimate: MotionEstimate, world: MotionWorld, figures: dict[str, Any]) -> dict[str, Any]:
    """Compute half-widths of the 95 % intervals, and the share of truth in them: 0, 1, or of the frames."""
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
