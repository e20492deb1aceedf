"""The motion stage: runs AOMotion and keeps its answer in one JSON file."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aomgen.core.joint import Joint
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.errors import CorruptArtifactError, EstimationError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.inputs import MotionInput
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
    demonstration: MotionInput,
    folder: Path,
    progress: Progress = silent,
    params: MotionParams | None = None,
    refused: Path | None = None,
) -> MotionEstimate:
    """Estimate the motion and write it to `folder`; see `estimate_motion` for what it raises.

    Args:
        demonstration: Video, log and scan.
        folder: Where the answer is written.
        progress: Hears how far it is.
        params: Of the submodules.
        refused: File that keeps the motion score when the answer is refused.
    """
    with keep_when_refused(refused) as curves:
        estimate = estimate_motion(demonstration, params, progress, curves.append)
    write_json(folder / FILE_NAME, asdict(estimate))
    progress(1.0, "motion")
    return estimate


@contextmanager
def keep_when_refused(refused: Path | None) -> Iterator[list[MotionCurve]]:
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
