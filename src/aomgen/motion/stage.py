"""The motion stage: runs AOMotion and keeps its answer in one JSON file."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from aomgen.core.joint import Joint
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.errors import CorruptArtifactError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.estimate import estimate_motion
from aomgen.motion.params import MotionParams

FILE_NAME = "motion.json"


def run_motion(
    demonstration: Demonstration,
    folder: Path,
    progress: Progress = silent,
    params: MotionParams | None = None,
) -> MotionEstimate:
    """Estimate the motion and write it to `folder`; see `estimate_motion` for what it raises."""
    estimate = estimate_motion(demonstration, params, progress)
    write_json(folder / FILE_NAME, asdict(estimate))
    progress(1.0, "motion")
    return estimate


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
