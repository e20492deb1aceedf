"""What a stage is, and what it gets to work with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aomgen.core.progress import Progress
from aomgen.core.project import Project
from aomgen.results import Results

# Figures under this name are sentences that the user should read: what may go wrong with this input.
WARNINGS = "warnings"

# Does the work of a stage in the given folder and returns figures worth reading.
StageFunction = Callable[[Results, Path, Progress], dict[str, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: For example "structure".
        folder: Folder below the run's folder, for example "01_structure".
        title: What the user reads while it runs.
        needs: Names of the stages it reads, "capture" when it reads the capture, and "assets" when it
            reads the files that the project names.
        settings: Names of the project's fields that change its result.
        version: Raised when the same inputs may give other bytes.
        weight: Seconds that it takes of the bundled recording on two cores, for the remaining time shown.
        function: Does the work.
        incremental: Works in its final folder, committing item by item or leaving checkpoints,
            and continues there after a kill.
        amount: Those of the settings that say how much is made, and change no item of an incremental
            stage: items that are there stay.
    """

    name: str
    folder: str
    title: str
    needs: tuple[str, ...]
    settings: tuple[str, ...]
    version: int
    weight: float
    function: StageFunction
    incremental: bool = False
    amount: tuple[str, ...] = ()


def results_of(project: Project, stages: Sequence[Stage]) -> Results:
    """The results of a project, where they lie or shall lie."""
    folders = {stage.name: project.out / stage.folder for stage in stages}
    return Results(project=project, out=project.out, folders=folders)
