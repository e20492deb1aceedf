"""What a stage is, and what it gets to work with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aomgen.core.progress import Progress
from aomgen.pipeline.project import Project


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run of the pipeline: its project and where the results of each stage lie.

    Attributes:
        project: The choices of this run.
        out: The run's folder.
        folders: Final folder of every stage, by stage name.
    """

    project: Project
    out: Path
    folders: dict[str, Path]

    @classmethod
    def of(cls, project: Project, out: Path, stages: Sequence["Stage"]) -> "Run":
        """The run of a project whose results lie, or shall lie, in a folder."""
        return cls(project=project, out=out, folders={stage.name: out / stage.folder for stage in stages})


# Figures under this name are sentences that the user should read: what may go wrong with this input.
WARNINGS = "warnings"

# Does the work of a stage in the given folder and returns figures worth reading.
StageFunction = Callable[[Run, Path, Progress], dict[str, Any]]


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
