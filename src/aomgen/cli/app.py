"""The command line: `aomgen --help` teaches the rest."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.evaluate_commands import evaluate_app
from aomgen.cli.export_commands import audit, export
from aomgen.cli.import_commands import import_app
from aomgen.cli.model_commands import assets_app, robot_app
from aomgen.cli.prompting import prompts
from aomgen.cli.run import COMMAND_LINE, RunFolder, run_command, run_project, sample_capture
from aomgen.cli.splat import splat
from aomgen.cli.view import view
from aomgen.errors import ConfigError
from aomgen.version import __version__

# Interval of `aomgen status --watch`, [s].
WATCH_S = 2.0

app = typer.Typer(**COMMAND_LINE)
app.add_typer(assets_app, name="assets")
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(import_app, name="import")
app.add_typer(robot_app, name="robot")
app.command()(export)
app.command()(audit)
app.command()(prompts)
app.command()(splat)
app.command()(view)


def main() -> None:
    """Entry point of `aomgen`."""
    run_command(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """One recorded demonstration in, many photoreal and physically verified demonstrations out."""


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(help="Where the results go.")] = Path("out"),
    poses: Annotated[
        int, typer.Option(min=1, max=10_000, help="Verified episodes for each of the two assets.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same episodes.")] = 0,
) -> None:
    """Turn the bundled recording into a verified dataset: capture -> dataset + report, on a CPU.

    Stop it whenever you like; the same command continues where it was.
    """
    from aomgen.core.project import Project

    project = Project(
        capture=sample_capture(),
        out=out.resolve(),
        seed=seed,
        poses=poses,
        assets=("microwave:1", "microwave:2"),
    )
    run_project(project)


@app.command()
def check(
    path: Annotated[Path, typer.Argument(help="A capture folder, a project.toml or a USD asset.")],
    html: Annotated[
        Path | None, typer.Option(help="Write a page about a capture, its worst images first.")
    ] = None,
) -> None:
    """Validate a capture, a project or an asset, with reasons; changes nothing.

    Scan images of a capture are matched at a small size, which takes some ten seconds: images that overlap with none of
    the others, and those that are exposed otherwise, are named before a run spends minutes on them.
    """
    from aomgen.assets.choice import asset_file, open_asset

    if asset_file(str(path)) is not None:
        joint = open_asset(str(path)).joint
        print(f"{path}: fine; {joint.type} joint, range {joint.lower:.3f} to {joint.upper:.3f}")
        return
    from aomgen.capture.capture_check import check_capture
    from aomgen.capture.read import read_capture
    from aomgen.pipeline.preflight import category_warnings, check_project, machine_warnings
    from aomgen.pipeline.project_file import read_project
    from aomgen.pipeline.stages import check_params

    if path.suffix == ".toml" and path.name != "capture.toml":
        project = read_project(path)
        check_params(project)
        capture = read_capture(project.capture)
        warnings = check_project(project, capture)
        warnings += machine_warnings(project.segmenter, capture, diffusion=bool(project.networks))
        print(f"{path}: fine")
    else:
        capture = read_capture(path.parent if path.name == "capture.toml" else path)
        checked = check_capture(capture)
        warnings = checked.warnings + category_warnings(capture) + machine_warnings("auto", capture)
        facts = checked.summary(capture)
        if capture.scan_images:
            from aomgen.capture.scan_images import read_grey
            from aomgen.report.capture_page import write_capture_page
            from aomgen.structure.overlap import measure_overlap

            greys = {path.name: read_grey(path) for path in capture.scan_images}
            overlap = measure_overlap(greys)
            warnings += tuple(overlap.list_warnings())
            facts += f"\n  walk   {overlap.describe_walk()}"
            if html is not None:
                write_capture_page(html, capture, greys, overlap, facts, warnings)
        print(f"{capture.folder}: fine\n{facts}")
    for sentence in warnings:
        print(f"  warning: {sentence}")


@app.command()
def masks(
    capture: Annotated[Path, typer.Argument(help="Folder with a capture.toml.")],
    weights: Annotated[str, typer.Option(help="Name of installed SAM 2 weights.")],
) -> None:
    """Follow the prompted parts through the scan with SAM 2; writes masks/<weights>/ of the capture."""
    from aomgen.pipeline.masks import write_masks

    print(f"wrote {write_masks(capture, weights, lambda share, text: print(f'  {share:4.0%} {text}'))}")


@app.command()
def init(
    capture: Annotated[Path, typer.Argument(help="Folder with a capture.toml.")],
    project: Annotated[Path, typer.Option(help="Project file to write.")] = Path("project.toml"),
    out: Annotated[Path, typer.Option(help="Where results will go.")] = Path("out"),
    assets: Annotated[
        list[str] | None,
        typer.Option("--asset", help="category:seed, a USD file or original; repeat for several."),
    ] = None,
    propose: Annotated[
        bool,
        typer.Option(
            "--propose",
            help="First add prompts of the parts that have none to capture.toml, from what moves in the video.",
        ),
    ] = False,
) -> None:
    """Write a project file with every choice spelled out, after checking capture and assets.

    With --propose, boxes around the robot, the moving part and the object's body are found within some minutes:
    the robot is what leaves its position in the video, and then its model; the moving part is what the gripper has
    carried away. They are marked `proposed = true` with a confidence. Confirm or correct them with `aomgen prompts`.
    """
    from aomgen.capture.read import read_capture
    from aomgen.pipeline.preflight import check_project, machine_warnings, new_project
    from aomgen.pipeline.project_file import write_project

    if project.exists():
        raise ConfigError(project, "exists already", "choose another name with --project")
    recorded = read_capture(capture, complete=not propose)
    choices = new_project(recorded, out, assets or [])
    warnings = check_project(choices, recorded)
    if propose:
        from aomgen.prompting.proposals import write_proposals

        for prompt in write_proposals(
            capture, lambda share, text: print(f"  {share:4.0%} {text}", flush=True)
        ):
            print(f"proposed {prompt.part} on {prompt.image}, confidence {prompt.confidence:.2f}")
        recorded = read_capture(capture)
        warnings = check_project(choices, recorded)
    warnings += machine_warnings(choices.segmenter, recorded)
    write_project(project, choices)
    for sentence in warnings:
        print(f"warning: {sentence}")
    print(f"wrote {project}; next: aomgen run {project}")


@app.command()
def run(
    project: Annotated[
        Path, typer.Argument(help="A project file, see `aomgen init`; or the folder of a run.")
    ],
    until: Annotated[str, typer.Option(help="Stop after this stage; `aomgen status` lists them.")] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A parameter of a stage, for example motion.joint.nodes=30; repeatable."),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Processes that make episodes; 0 for one a processor.")
    ] = 0,
    ray: Annotated[
        str, typer.Option(help="Make episodes on a Ray cluster that sees these folders: auto, or HOST:PORT.")
    ] = "",
) -> None:
    """Bring every stage of a project up to date; what is up to date is kept.

    Parameters are the fields of the stages' Params classes (`PARAMETERS` in pipeline/stages.py); an unknown name
    is refused with a list of the known ones. They are kept in the run's project.toml.
    """
    from aomgen.api.run import change_project
    from aomgen.io.schema import merge, parse_setting
    from aomgen.pipeline.stages import find_project

    found = find_project(project)
    params = found.params
    for setting in settings or ():
        params = merge(params, parse_setting(setting))
    machine = {"ray": ray} | ({"workers": workers} if workers else {})
    run_project(change_project(found, {"params": params}), until=until, **machine)


@app.command()
def status(
    out: RunFolder,
    watch: Annotated[
        bool, typer.Option("--watch", help="Say it again whenever it changes, until the episodes are made.")
    ] = False,
) -> None:
    """List the stages of a run, what is done, and what has come of the episodes asked for."""
    from aomgen.cli.run import status_lines
    from aomgen.pipeline.stages import find_project

    project = find_project(out)
    shown: list[str] = []
    while True:
        lines, left = status_lines(project)
        if lines != shown:
            print("\n".join(lines), flush=True)
            shown = lines
        if not (watch and left):
            break
        time.sleep(WATCH_S)


@app.command()
def render(
    out: RunFolder,
    image: Annotated[Path, typer.Argument(help="PNG to write.")],
    camera: Annotated[
        str,
        typer.Option(
            help="A camera of demonstration or episodes (front, side), a scan image (0012.jpg), or a JSON "
            "file: T_world_cam, fx, fy, cx, cy, width, height."
        ),
    ],
    state: Annotated[
        Path | None, typer.Option(help="JSON: joints, gripper, theta, T_world_object; each optional.")
    ] = None,
    labels: Annotated[Path | None, typer.Option(help="Also write the part labels to this PNG.")] = None,
) -> None:
    """Draw the twin of a finished run from any camera, in any state."""
    from aomgen.io.artifact import read_json
    from aomgen.io.images import write_image
    from aomgen.pipeline.rendering import find_camera, open_twin, parse_camera, parse_state, render_twin
    from aomgen.pipeline.runner import results_of
    from aomgen.pipeline.stages import STAGES, find_project

    project = find_project(out)
    twin, robot = open_twin(project.out)
    if camera.endswith(".json"):
        view = parse_camera(read_json(Path(camera)), Path(camera))
    else:
        view = find_camera(results_of(project, STAGES), camera)
    where = parse_state(read_json(state) if state else {}, twin, robot, state or Path("state"))
    image_srgb, _, parts = render_twin(twin, robot, view, where)
    write_image(image, image_srgb)
    if labels:
        write_image(labels, parts)


@app.command()
def report(out: RunFolder) -> None:
    """Write report.html again from what a run has made."""
    from aomgen.pipeline.stages import find_project
    from aomgen.report.page import write_report

    print(write_report(find_project(out).out))


@app.command()
def doctor() -> None:
    """Say what is installed, what is missing, and what each part is for."""
    from aomgen.pipeline.requirements import diagnose

    problems = 0
    for name, state, purpose in diagnose():
        print(f"{name:22} {state or 'ok':60} {purpose}")
        problems += bool(state)
    if problems:
        sys.exit(4)
