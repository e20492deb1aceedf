"""Running a project in a terminal."""

import sys

from aomgen.errors import EstimationError


def run_project(project, *, until: str = ""):
    """Run the pipeline with a terminal display and say where the results are."""
    from aomgen.cli_display import TerminalDisplay
    from aomgen.pipeline.estimates import forget_refusal
    from aomgen.pipeline.stages import REPORT_FILE, run_pipeline

    forget_refusal(project.out)
    try:
        with TerminalDisplay() as display:
            changed = run_pipeline(project, display, until=until)
    except EstimationError as error:
        from aomgen.report.refusal import write_refusal

        page = write_refusal(project.out, str(error))
        if page is not None:
            print(f"evidence {page}", file=sys.stderr)
        raise
    if not until:
        if changed or not (project.out / REPORT_FILE).exists():
            from aomgen.report.page import write_report

            write_report(project.out)
        print(f"dataset  {project.out / 'dataset'}")
        print(f"report   {project.out / 'report.html'}")
