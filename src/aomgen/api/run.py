"""Runs of the pipeline on disk: computing, opening and reading them."""

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from aomgen.api.arguments import require_known_keys, require_name
from aomgen.api.capture import Capture
from aomgen.api.display import CallbackDisplay, display
from aomgen.api.twin import Twin
from aomgen.core.camera import Camera
from aomgen.core.demonstration import Demonstration
from aomgen.core.motion import MotionEstimate
from aomgen.core.plan import FittedAsset
from aomgen.core.project import Project
from aomgen.errors import ConfigError, EstimationError
from aomgen.exports.formats import export_twin
from aomgen.io.episode_folder import CommittedEpisode, list_committed, read_episode
from aomgen.io.schema import complaint
from aomgen.motion.estimates_file import forget_refusal
from aomgen.pipeline.manifest import RunRecord, save_record
from aomgen.pipeline.preflight import new_project
from aomgen.pipeline.rendering import list_cameras, open_twin
from aomgen.pipeline.runner import Display, results_of, stage_states
from aomgen.pipeline.stages import REPORT_FILE, STAGES, find_project, require_stage, run_pipeline
from aomgen.report.motion_section import write_refusal
from aomgen.report.page import write_report
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.version import __version__

# True shows progress bars in a terminal and lines otherwise; a function receives the completed share and a text.
ProgressOption = bool | Callable[[float, str], None]
T = TypeVar("T")


class Run:
    """Results of a run: its twin, demonstration, cameras and episodes, each loaded at its first use.

    Args:
        results: Inputs and results by stage; use `Run.open` or `reconstruct` instead.

    Example:
        >>> run = ag.Run.open("out")
        >>> run.status()["twin"]
        'done'
        >>> run.demonstration.joint.type
        'revolute'
        >>> sorted(run.cameras)[-2:]
        ['front', 'side']
    """

    def __init__(self, results: Results) -> None:
        self.results = results

    @classmethod
    def open(cls, folder: str | Path) -> "Run":
        """Open the folder of a run; the folder may have been moved.

        Raises:
            MissingFileError: The folder does not exist or does not contain a run.
            ConfigError: Its project file is not valid.

        Example:
            >>> ag.Run.open("out").folder.name
            'out'
        """
        return cls(results_of(find_project(Path(folder)), STAGES))

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.results.out

    @property
    def project(self) -> Project:
        """Settings of the run."""
        return self.results.project

    @property
    def capture(self) -> Capture:
        """The capture of the run."""
        return Capture(self.results.recorded)

    @property
    def robot(self) -> RobotModel:
        """The robot of the capture."""
        return self.results.robot

    def status(self) -> dict[str, str]:
        """Return "done", "partial" or "missing" for every stage.

        Example:
            >>> list(ag.Run.open("out").status())[:2]
            ['structure', 'gaussians']
        """
        return {stage.name: state for stage, state in stage_states(self.project, STAGES)}

    @cached_property
    def twin(self) -> Twin:
        """The digital twin of the recorded scene.

        Raises:
            MissingFileError: Stage "twin" has not finished.
            OutdatedRunError: The stage was computed by another version of AOMGen.
        """
        self.require_stage("twin")
        return Twin(*open_twin(self.folder))

    @property
    def motion(self) -> MotionEstimate:
        """The object's joint and its values over the video, with their uncertainties; errors as for `twin`."""
        self.require_stage("motion")
        return self.results.motion

    @property
    def demonstration(self) -> Demonstration:
        """Robot and object from the first to the last video frame; errors as for `twin`."""
        self.require_stage("motion")
        return self.results.demonstration

    @cached_property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras of scan images, videos and episodes by name, world frame; errors as for `twin`."""
        self.require_stage("alignment")
        return list_cameras(self.results)

    @property
    def fits(self) -> list[FittedAsset]:
        """Assets of the run, fitted to the recorded motion; errors as for `twin`."""
        self.require_stage("replacement")
        return self.results.fitted_assets

    @property
    def episodes(self) -> list[CommittedEpisode]:
        """Committed episodes, checked against their digests.

        Raises:
            CorruptArtifactError: A file of an episode does not match its digest.
        """
        return [read_episode(folder) for folder in list_committed(self.results.folders["episodes"])]

    def export(
        self,
        file: str | Path,
        *,
        episode: int | None = None,
        joint: float | None = None,
        time_s: float | None = None,
    ) -> Path:
        """Write the twin and a motion to a file for other programs; an existing file is replaced.

        Args:
            file: File to write; its suffix selects the format: .usda, .usdc, .usdz, .xml (MJCF), .ply, .splat, .spz,
                .glb, .rrd, .mcap.
            episode: Number of an episode; None selects the recorded demonstration (for .xml the first episode).
            joint: Value of the object's joint, [rad] or [m]; only for Gaussian splatting files.
            time_s: Time of the state in the motion, [s]; only for Gaussian splatting files.

        Returns:
            The file.

        Raises:
            UnknownNameError: The suffix or the episode is unknown; the error lists the known ones.
            MissingFileError: A stage has not finished.
            BackendError: A package is missing.

        Example:
            >>> run = ag.Run.open("out")
            >>> run.export("half_open.ply", joint=0.5).name
            'half_open.ply'
        """
        export_twin(self.results, Path(file), episode=episode, joint=joint, time_s=time_s)
        return Path(file)

    def require_stage(self, name: str) -> None:
        """Refuse a run whose stage has not finished or was computed by another version.

        Raises:
            MissingFileError: The stage has not finished.
            OutdatedRunError: The stage was computed by another version; the message states the command that updates it.
        """
        require_stage(self.results, name)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"


def reconstruct(
    capture: Capture | str | Path,
    out: str | Path,
    *,
    until: str = "twin",
    assets: Sequence[str] = (),
    progress: ProgressOption = True,
    **choices: Any,
) -> Run:
    """Reconstruct a capture as a digital twin; up to date results are kept, and an interrupted call continues.

    Args:
        capture: A capture or its folder.
        out: Folder of the results; it is created if it does not exist.
        until: Last stage to run: "structure", "gaussians", "alignment", "parts", "motion", "twin", "replacement",
            "episodes" or "dataset".
        assets: Assets that replace the object from stage "replacement" on: `category:seed`, USD files, or "original".
        progress: Whether to show the progress; a function receives the completed share of a stage and a text.
        choices: Other settings of the project, for example `iterations=3000`; `aomgen init` writes a list of them.

    Raises:
        UnknownNameError: A stage or setting is unknown; the error lists the known ones.
        InputError: The capture cannot be used.
        EstimationError: An estimator refuses the data; the subclass states the reason.

    Example:
        >>> run = ag.reconstruct("my_capture", "out", progress=False, assets=["microwave:1", "microwave:2"])
        >>> run.status()["twin"]
        'done'
    """
    recorded = capture if isinstance(capture, Capture) else Capture.load(capture)
    require_name("until", until, [stage.name for stage in STAGES])
    project = change_project(new_project(recorded.recording, Path(out), assets), choices)
    bring_up_to_date(project, until=until, progress=progress)
    return Run(results_of(project, STAGES))


def change_project(project: Project, choices: Mapping[str, Any]) -> Project:
    """Return a project with some fields changed.

    Raises:
        UnknownNameError: There is no such field.
        ConfigError: A value is outside its range.
    """
    require_known_keys("project", choices, Project.model_fields)
    try:
        return Project.model_validate(project.model_dump() | dict(choices))
    except ValidationError as error:
        raise ConfigError("project", *complaint(error, Project)) from error


def bring_up_to_date(
    project: Project, *, until: str = "", progress: ProgressOption | CallbackDisplay = True, **machine: Any
) -> list[str]:
    """Run the stages of a project that are not up to date, and write the report of a whole run.

    Args:
        project: Settings of the run.
        until: Last stage to run; all stages are run if it is empty.
        progress: See `reconstruct`; or the display that receives the progress.
        machine: Execution of the episodes, see `Results`: `workers`, `ray`, `store`.

    Returns:
        Names of the stages that were computed.

    Raises:
        ConfigError: The path of the results is a file.
        AomgenError: A stage failed.
    """
    if project.out.exists() and not project.out.is_dir():
        raise ConfigError(project.out, "is a file, but results need a folder", "choose another name")
    forget_refusal(project.out)
    try:
        with _open_display(progress) as shown:
            changed = run_pipeline(project, shown, until=until, **machine)
    except EstimationError as error:
        write_refusal(project.out, str(error))
        raise
    if changed:
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        save_record(project.out, RunRecord(command=_describe_command(), version=__version__, finished=now))
    if not until and (changed or not (project.out / REPORT_FILE).exists()):
        write_report(project.out)
    return changed


def _describe_command() -> str:
    """Return the running command or script as a user would type it."""
    script = Path(sys.argv[0])
    if script.name == "__main__.py":
        program = ["python", "-m", script.parent.name]
    else:
        program = ["python", str(script)] if script.suffix == ".py" else [script.name]
    return shlex.join([*program, *sys.argv[1:]])


def _open_display(progress: ProgressOption | CallbackDisplay) -> AbstractContextManager[Display]:
    if progress is True:
        return display()
    if isinstance(progress, CallbackDisplay):
        return nullcontext(progress)
    return nullcontext(CallbackDisplay(progress or None))
