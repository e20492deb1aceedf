"""The motion stage: runs AOMotion and keeps its answer in one JSON file."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aomgen.core.joint import Joint
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, part, silent
from aomgen.errors import CorruptArtifactError, EstimationError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.paper.estimate import PaperParams, estimate_motion_paper
from aomgen.motion.paper.keyframes import PartMasks
from aomgen.motion.params import MotionParams

FILE_NAME = "motion.json"


def save_curve(path: Path, curve: MotionCurve) -> None:
    """Keep the motion score of a demonstration that was refused."""
    write_json(path, asdict(curve))


def load_curve(path: Path) -> MotionCurve:
    """Read back what `save_curve` wrote.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or not JSON.
        CorruptArtifactError: It is JSON of something else.
    """
    content: Any = read_json(path)
    try:
        return MotionCurve(**content)
    except (TypeError, ValueError) as error:
        raise CorruptArtifactError(path, f"is not a motion score ({error})", "run the stage again") from error


def run_motion(
    demonstration: Demonstration,
    folder: Path,
    progress: Progress = silent,
    params: MotionParams | None = None,
    refused: Path | None = None,
) -> MotionEstimate:
    """Estimate the motion and write it to `folder`; see `estimate_motion` for what it raises.

    Args:
        demonstration: Film, log and scan.
        folder: Where the answer is written.
        progress: Hears how far it is.
        params: Of the submodules.
        refused: File that keeps the motion score when the answer is refused.
    """
    with _kept_when(refused) as curves:
        estimate = estimate_motion(demonstration, params, progress, curves.append)
    write_json(folder / FILE_NAME, asdict(estimate))
    progress(1.0, "motion")
    return estimate


def run_paper_motion(
    demonstration: Demonstration,
    masks: PartMasks,
    folder: Path,
    progress: Progress = silent,
    refused: Path | None = None,
) -> MotionEstimate:
    """Estimate the motion as the paper does, formulas as printed, and write it to `folder`.

    The paper takes the joint's type as known; here it is the one that our own estimator finds, so
    both have to answer; see `estimate_motion` and `estimate_motion_paper` for what they raise, and
    `run_motion` for the arguments.
    """
    ours, papers = part(progress, 0.0, 0.7), part(progress, 0.7, 1.0)
    with _kept_when(refused) as curves:
        params = PaperParams(joint_type=estimate_motion(demonstration, None, ours, curves.append).joint.type)
        estimate = estimate_motion_paper(demonstration, masks, params, papers, curves.append)
    write_json(folder / FILE_NAME, asdict(estimate))
    progress(1.0, "motion")
    return estimate


@contextmanager
def _kept_when(refused: Path | None) -> Iterator[list[MotionCurve]]:
    """A list of motion scores whose last one is saved when an answer is refused."""
    curves: list[MotionCurve] = []
    try:
        yield curves
    except EstimationError:
        if refused is not None and curves:
            save_curve(refused, curves[-1])
        raise


def load_motion(folder: Path) -> MotionEstimate:
    """Read back what `run_motion` wrote.

    Raises:
        MissingFileError, MalformedFileError: The file is missing or not JSON.
        CorruptArtifactError: It is JSON of something else.
    """
    path = folder / FILE_NAME
    content: Any = read_json(path)
    try:
        return MotionEstimate(
            **{
                **content,
                "curve": MotionCurve(**content["curve"]),
                "contacts": tuple(ContactPatch(**patch) for patch in content["contacts"]),
                "joint": Joint(**content["joint"]),
            }
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptArtifactError(
            path, f"is not a motion estimate ({error})", "run the stage again"
        ) from error
