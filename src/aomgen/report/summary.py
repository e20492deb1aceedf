"""The report's head: what came out, and what made it; its times; and what to do next."""

import shlex

from aomgen import __version__
from aomgen.errors import MissingFileError
from aomgen.io.jsonfile import read_json
from aomgen.pipeline.figures import Reading, read_figures
from aomgen.pipeline.manifest import Manifest, read_manifest
from aomgen.pipeline.run_record import load_record
from aomgen.pipeline.runner import TIMINGS
from aomgen.pipeline.stages import PROJECT_FILE, STAGES
from aomgen.report.html import Markup, bar, commands, heading, paragraph, reading, table, text
from aomgen.results import Results

# The figures that a reader looks for first: stage, names.
HEADLINES = (
    ("plans", ("verified", "smallest_margin")),
    ("dataset", ("frames",)),
    ("structure", ("registered", "of", "reprojection_error_px")),
    ("gaussians", ("heldout_psnr",)),
    ("alignment", ("end_effector_sd_mm",)),
    ("motion", ("joint", "axis_ci95_deg", "clock_offset_s")),
)


def results_table(results: Results) -> str:
    """The most telling figures with what is good."""
    rows: list[list[object]] = []
    for stage, names in HEADLINES:
        figures = manifest_of(results, stage).figures
        chosen = {name: figures[name] for name in names if name in figures}
        rows += [_reading_row(item) for item in read_figures(stage, chosen)]
    return table(["result", "", ""], rows)


def provenance_table(results: Results) -> str:
    """Version, date, seed and command of a run, and how to make it again."""
    record, project = load_record(results.out), results.project
    rows: list[list[object]] = [
        ["AOMGen", record.version if record else __version__],
        ["finished", record.finished.replace("T", " ") if record else "not recorded"],
        ["command", _code(record.command) if record else "not recorded"],
        ["again", _code(shlex.join(["aomgen", "run", _project_file(results)]))],
        # A seed is a name: it stands left, like the rest.
        ["seed", Markup(html=text(project.seed))],
        ["recording", str(project.capture)],
        ["assets", ", ".join(project.assets)],
    ]
    return table(["made with", ""], rows)


def stages_table(results: Results) -> str:
    """Seconds of each stage, their share of the whole, and the figures."""
    seconds = read_json(results.out / TIMINGS)
    total = max(sum(seconds.values()), 1e-9)
    rows: list[list[object]] = []
    for stage in STAGES:
        spent = float(seconds.get(stage.name, 0.0))
        items = read_figures(stage.name, manifest_of(results, stage.name).figures)
        figures = Markup(html="; ".join(reading(item) for item in items))
        rows.append([stage.title, f"{spent:.1f}", f"{100 * spent / total:.0f}", bar(spent / total), figures])
    head = ["stage", "seconds", "% of all", Markup(html='<div style="width:130px"></div>'), "figures"]
    return table([*head], [*rows, ["all", f"{total:.1f}", "100", "", ""]])


def next_steps(results: Results) -> list[str]:
    """The commands with which a reader goes on from this run."""
    out = shlex.quote(str(results.out.resolve()))
    project = shlex.quote(_project_file(results))
    camera = next(iter(results.episode_scene.cameras))
    halfway = 0.5 * float(results.motion.thetas.max())
    usd = sorted((results.folders["replacement"] / "assets").glob("*/asset.usda"))
    steps = [
        heading("More episodes, other assets"),
        paragraph(
            f"Poses, assets and everything else that was chosen is in {PROJECT_FILE}; assets are category:seed or "
            "paths of USD files. The recording is not worked on again."
        ),
        commands(f"sed -i 's/^poses = .*/poses = 50/' {project}\naomgen run {project}"),
        heading("Other views of the scene"),
        commands(
            f"aomgen render {out} view.png --camera {camera}\n"
            f"echo '{{\"theta\": {halfway:.2f}}}' > state.json\n"
            f"aomgen render {out} view.png --camera {camera} --state state.json --labels parts.png"
        ),
        heading("The dataset in LeRobot"),
        commands(
            "from lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
            f'dataset = LeRobotDataset("local/{results.out.resolve().name}", root="{results.out.resolve() / "dataset"}")'
        ),
    ]
    if usd:
        steps += [
            heading("The fitted assets as USD"),
            commands("\n".join(f"aomgen check {shlex.quote(str(path.resolve()))}" for path in usd)),
        ]
    return steps


def manifest_of(results: Results, stage: str) -> Manifest:
    """The manifest of a finished stage.

    Raises:
        MissingFileError: The stage is not finished.
    """
    manifest = read_manifest(results.folders[stage])
    if manifest is None:
        raise MissingFileError(results.folders[stage], "is not finished", "run the project first")
    return manifest


def _reading_row(item: Reading) -> list[object]:
    limit = Markup(html=f'<span class="{item.verdict}">{text(_judged(item))}</span>')
    return [item.name, Markup(html=text(item.value)), limit]


def _judged(item: Reading) -> str:
    return f"poor, {item.limit}" if item.verdict == "poor" else item.limit


def _project_file(results: Results) -> str:
    return str(results.out.resolve() / PROJECT_FILE)


def _code(words: str) -> Markup:
    return Markup(html=f"<code>{text(words)}</code>")
