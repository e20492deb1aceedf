"""Running a project in a terminal."""


def run_project(project, *, until: str = ""):
    """Run the pipeline with a terminal display and say where the results are."""
    from aomgen.cli_display import TerminalDisplay
    from aomgen.pipeline.stages import REPORT_FILE, run_pipeline

    with TerminalDisplay() as display:
        changed = run_pipeline(project, display, until=until)
    if not until:
        if changed or not (project.out / REPORT_FILE).exists():
            from aomgen.report.page import write_report

            write_report(project.out)
        print(f"dataset  {project.out / 'dataset'}")
        print(f"report   {project.out / 'report.html'}")
