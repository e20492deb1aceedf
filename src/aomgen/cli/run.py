"""Running a project in a terminal, and finding the project that a path means."""

import shlex
import sys
from datetime import datetime
from pathlib import Path

from aomgen import __version__
from aomgen.errors import ConfigError, EstimationError, MissingFileError


def run_project(project, *, until: str = ""):
    """Run the pipeline with a display and say where the results are.

    Raises:
        ConfigError: The results would go where a file is.
        AomgenError: Whatever a stage refuses.
    """
    from aomgen.cli.display import display
    from aomgen.motion.estimates_file import forget_refusal
    from aomgen.pipeline.manifest import RunRecord, save_record
    from aomgen.pipeline.stages import REPORT_FILE, run_pipeline

    if project.out.exists() and not project.out.is_dir():
        raise ConfigError(project.out, "is a file, and results need a folder", "choose another name")
    forget_refusal(project.out)
    try:
        with display() as shown:
            changed = run_pipeline(project, shown, until=until)
    except EstimationError as error:
        from aomgen.report.motion_section import write_refusal

        page = write_refusal(project.out, str(error))
        if page is not None:
            print(f"evidence {page}", file=sys.stderr)
        raise
    if changed:
        command = shlex.join(["aomgen", *sys.argv[1:]])
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        save_record(project.out, RunRecord(command=command, version=__version__, finished=now))
    if not until:
        if changed or not (project.out / REPORT_FILE).exists():
            from aomgen.report.page import write_report

            write_report(project.out)
        print(f"dataset  {project.out / 'dataset'}")
        print(f"report   {project.out / 'report.html'}")


def find_project(path: Path):
    """The project that a path means: a project file, or the folder of a run, wherever that has been moved.

    Raises:
        MissingFileError: There is nothing of both.
        ConfigError: The project file is not valid.
    """
    from aomgen.pipeline.project_file import read_project
    from aomgen.pipeline.stages import PROJECT_FILE, STAGES

    remedy = "give the folder of a run, or a project file"
    if not path.exists():
        raise MissingFileError(path, "is missing", remedy)
    if not path.is_dir():
        return read_project(path)
    file = path / PROJECT_FILE
    if not file.is_file():
        raise MissingFileError(path, f"holds no {PROJECT_FILE}", remedy)
    project = read_project(file)
    has_results = any((path / stage.folder).is_dir() for stage in STAGES)
    return project.model_copy(update={"out": path.resolve()}) if has_results else project
