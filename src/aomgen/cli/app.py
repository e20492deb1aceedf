"""The command line; `aomgen --help` lists the commands."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from aomgen.cli.corpus import corpus
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
app.command()(corpus)
app.command()(prompts)
app.command()(splat)
app.command()(view)


def main() -> None:
    """Run the command line `aomgen`."""
    run_command(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Turn one recorded robot demonstration into many photoreal demonstrations, each verified in simulation."""


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(help="Folder for the results.")] = Path("out"),
    poses: Annotated[
        int, typer.Option(min=1, max=10_000, help="Verified episodes for each of the two assets.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Random seed; the same seed gives the same episodes.")] = 0,
) -> None:
    """Reconstruct the bundled recording and generate episodes.

    The command writes a dataset and a report and needs no GPU. It can be stopped at any time; the same command
    continues where it stopped. The weights of the segmentation network are downloaded (45 MB) if they are missing.
    """
    from aomgen.core.project import Project
    from aomgen.pipeline.runner import stage_states
    from aomgen.pipeline.stages import STAGES
    from aomgen.segmentation.weights import ensure_weights

    project = Project(
        capture=sample_capture(),
        out=out.resolve(),
        seed=seed,
        poses=poses,
        assets=("microwave:1", "microwave:2"),
    )
    if any(stage.name == "parts" and state != "done" for stage, state in stage_states(project, STAGES)):
        ensure_weights("mobile_sam", lambda sentence: print(sentence, file=sys.stderr))
    run_project(project)


@app.command()
def check(
    path: Annotated[Path, typer.Argument(help="A capture folder, a project.toml or a USD asset.")],
    html: Annotated[
        Path | None,
        typer.Option(help="Also write an HTML page that shows the images of a capture, the worst first."),
    ] = None,
) -> None:
    """Check a capture, a project or an asset.

    The command explains each problem and changes no file. It also matches the scan images of a capture at a small size,
    which takes about ten seconds, and lists images that overlap with no other image or have a different exposure.
    """
    from aomgen.assets.choice import asset_file, open_asset

    is_asset, is_project = asset_file(str(path)), path.suffix == ".toml" and path.name != "capture.toml"
    if html is not None and (is_asset or is_project):
        raise ConfigError("--html", "shows the images of a capture", "give the folder of the capture")
    if is_asset:
        joint = open_asset(str(path)).joint
        print(f"{path}: ok; {joint.type} joint, range {joint.lower:.3f} to {joint.upper:.3f}")
        return
    from aomgen.capture.capture_check import check_capture
    from aomgen.capture.read import read_capture
    from aomgen.pipeline.preflight import category_warnings, check_project, machine_warnings
    from aomgen.pipeline.project_file import read_project
    from aomgen.pipeline.stages import check_params

    if is_project:
        project = read_project(path)
        check_params(project)
        capture = read_capture(project.capture)
        warnings = check_project(project, capture)
        warnings += machine_warnings(project.segmenter, capture, diffusion=bool(project.networks))
        print(f"{path}: ok")
    else:
        capture = read_capture(path.parent if path.name == "capture.toml" else path)
        _, facts, doubts = check_capture(capture)
        warnings = doubts + category_warnings(capture) + machine_warnings("auto", capture)
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
        print(f"{capture.folder}: ok\n{facts}")
    for sentence in warnings:
        print(f"  warning: {sentence}")


@app.command()
def masks(
    capture: Annotated[Path, typer.Argument(help="Folder with a capture.toml.")],
    weights: Annotated[
        str,
        typer.Option(
            help="Name of installed SAM 2 weights; `python -m aomgen.segmentation.sam2_weights --help` installs them."
        ),
    ],
) -> None:
    """Segment the prompted parts in every scan image with SAM 2.

    The masks are written to the folder masks/<weights> of the capture.
    """
    from aomgen.pipeline.masks import write_masks

    print(f"wrote {write_masks(capture, weights, lambda share, text: print(f'  {share:4.0%} {text}'))}")


@app.command()
def init(
    capture: Annotated[Path, typer.Argument(help="Folder with a capture.toml.")],
    project: Annotated[Path, typer.Option(help="Project file to write.")] = Path("project.toml"),
    out: Annotated[Path, typer.Option(help="Folder for the results of the run.")] = Path("out"),
    assets: Annotated[
        list[str] | None,
        typer.Option(
            "--asset", help="Asset: category:seed, a USD file, or 'original'; repeat the option for several."
        ),
    ] = None,
    propose: Annotated[
        bool,
        typer.Option(
            "--propose",
            help="First add prompts to capture.toml for the parts that have none, derived from the motion in the video.",
        ),
    ] = False,
) -> None:
    """Check a capture and its assets, and write a project file with all settings.

    The project file contains every setting with its default value and a comment. An existing project file is not
    overwritten.

    With --propose, the command first adds missing prompts to capture.toml, which takes some minutes. It derives boxes
    around the robot, the moving part and the static part from the motion in the demonstration video. They are marked
    `proposed = true` and have a confidence. Confirm or correct them with `aomgen prompts`.
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
        Path, typer.Argument(help="Project file (see `aomgen init`), or the folder of a run.")
    ],
    until: Annotated[str, typer.Option(help="Stop after this stage; `aomgen status` lists them.")] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Set a parameter of a stage: STAGE.NAME=VALUE, for example motion.joint.nodes=30; repeatable.",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=0, help="Number of processes that generate episodes; 0 means one for each CPU core."
        ),
    ] = 0,
    ray: Annotated[
        str,
        typer.Option(
            help="Generate episodes on a Ray cluster (auto or HOST:PORT) that can access the run's folders, or --store."
        ),
    ] = "",
    store: Annotated[
        str,
        typer.Option(
            help="Object store (for example s3://bucket/run) or shared folder, for a Ray cluster without access to the "
            "run's folders."
        ),
    ] = "",
) -> None:
    """Run the stages of a project that are missing or out of date.

    Results that are up to date are kept. docs/episodes.md lists the parameters of the stage "episodes". An unknown name
    is refused with a list of the known ones. Parameters given with --set are stored in the project.toml of the run.
    """
    from aomgen.api.run import change_project
    from aomgen.io.schema import merge, parse_setting
    from aomgen.pipeline.stages import find_project

    found = find_project(project)
    params = found.params
    for setting in settings or ():
        params = merge(params, parse_setting(setting))
    if store and not ray:
        raise ConfigError("--store", "has no meaning without --ray", "leave it out")
    machine = {"ray": ray, "store": store} | ({"workers": workers} if workers else {})
    run_project(change_project(found, {"params": params}), until=until, **machine)


@app.command()
def status(
    out: RunFolder,
    watch: Annotated[
        bool, typer.Option("--watch", help="Print the status at every change, until the run is complete.")
    ] = False,
) -> None:
    """List the stages of a run with their states, and count episodes and rejected samples."""
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
    image: Annotated[Path, typer.Argument(help="PNG file to write.")],
    camera: Annotated[
        str,
        typer.Option(
            help="Camera of the demonstration or the episodes (front, side), scan image (0012.jpg), or JSON file with "
            "T_world_cam, fx, fy, cx, cy, width and height."
        ),
    ],
    state: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with joints [rad], gripper (0 open .. 1 closed), theta (the object's joint value, [rad] or "
            "[m]) and T_world_object (4x4), all optional."
        ),
    ] = None,
    labels: Annotated[Path | None, typer.Option(help="Also write the part labels to this PNG.")] = None,
) -> None:
    """Render the twin of a finished run from any camera, in any state."""
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
    """Write report.html again from the results of a run."""
    from aomgen.pipeline.stages import find_project
    from aomgen.report.page import write_report

    print(write_report(find_project(out).out))


@app.command()
def doctor() -> None:
    """List the required components, their state and their purpose."""
    from aomgen.pipeline.requirements import diagnose

    problems = 0
    for name, problem, purpose in diagnose():
        print(f"{name:12} {purpose:45} {problem or 'ok'}")
        problems += bool(problem)
    if problems:
        sys.exit(4)
