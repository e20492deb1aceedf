"""`report.html`: what a run recovered and made, in images and numbers."""

import shlex
from functools import partial
from pathlib import Path

import numpy as np

from aomgen.errors import MissingFileError
from aomgen.io.atomic import write_text
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.images import resize, write_image
from aomgen.io.reuse import reuse, reuse_object
from aomgen.pipeline.figures import FIGURES, Reading, read_figure, read_figures
from aomgen.pipeline.manifest import RUN_RECORD, Manifest, load_record, read_manifest
from aomgen.pipeline.project_file import read_project
from aomgen.pipeline.runner import TIMINGS, results_of
from aomgen.pipeline.stages import PROJECT_FILE, REPORT_FILE, STAGES
from aomgen.report import images
from aomgen.report.episodes import draws_section, episodes_section, rejects_section
from aomgen.report.html import (
    Markup,
    bar,
    commands,
    contents,
    heading,
    link,
    page,
    paragraph,
    picture,
    reading,
    section,
    table,
    text,
)
from aomgen.report.images import sheet
from aomgen.report.motion_section import motion_section
from aomgen.results import Results
from aomgen.version import __version__

CONTACT_SHEET = "episodes.jpg"
# Name in the run's folder under which `aomgen view --export` writes the page that the report links to.
OFFLINE_PAGE = "page.html"
SHEET_FRAMES, SHEET_EPISODES = 5, 12
# The most important figures: stage, names.
HEADLINES = (
    ("episodes", ("episodes", "smallest_margin")),
    ("dataset", ("frames",)),
    ("structure", ("registered", "of", "reprojection_error_px")),
    ("gaussians", ("heldout_psnr",)),
    ("alignment", ("end_effector_sd_mm",)),
    ("motion", ("joint", "axis_ci95_deg", "clock_offset_s")),
)


def write_report(out: Path) -> Path:
    """Write `report.html` and the contact sheet of a finished run.

    Returns:
        Path of the report.

    Raises:
        MissingFileError: The run is not finished.
    """
    project = read_project(out / PROJECT_FILE)
    results = results_of(project, STAGES)
    manifest_of(results, "dataset")
    write_image(out / CONTACT_SHEET, contact_sheet(results))
    sections = {
        "Warnings": _warnings(results),
        "Episodes": [
            picture(
                sheet(images.demo_strip(results, SHEET_FRAMES), SHEET_FRAMES),
                "The recorded demonstration.",
            ),
            *episodes_section(results),
        ],
        "Requested and committed episodes": draws_section(results),
        "Rejected poses": rejects_section(results),
        "What next": next_steps(results),
        **_render_estimate_sections(results),
        "Time and metrics of the stages": [stages_table(results)],
    }
    shown = {title: parts for title, parts in sections.items() if parts}
    name = f"{results.recorded.name}: {results.recorded.instruction}"
    body = [
        f"<h1>{text(name)}</h1>",
        contents(list(shown)),
        *_link_offline_page(out),
        f'<div class="head"><div>{results_table(results)}</div><div>{provenance_table(results)}</div></div>',
        *(section(title, *parts) for title, parts in shown.items()),
    ]
    write_text(out / REPORT_FILE, page(f"AOMGen: {results.recorded.name}", body))
    return out / REPORT_FILE


def _link_offline_page(out: Path) -> list[str]:
    if not (out / OFFLINE_PAGE).is_file():
        return []
    return [f"<p>{link(OFFLINE_PAGE, 'The twin with a joint slider, and all episodes, on one page')}</p>"]


def _render_estimate_sections(results: Results) -> dict[str, list[str]]:
    """Write the sections on the reconstruction, from the scan to the replay of the video."""
    return {
        "Scene": [
            paragraph(
                "Held-out scan images (above) and the twin rendered from the same camera poses (below)."
            ),
            picture(images.heldout_sheet(results), "held-out views"),
            paragraph("Part labels: robot blue, static part orange, moving part pink."),
            picture(images.parts_sheet(results), "parts"),
        ],
        "Coverage": [
            paragraph(
                "Coverage of the scan: sides of object, robot and table in a top view, with the scan cameras. "
                "Green: enough "
                "views from different directions. Yellow: too few. Red: none; the surfaces there are guessed."
            ),
            picture(images.coverage_map(results), "coverage"),
            _coverage(results),
        ],
        "Alignment": [
            paragraph("The robot model's outline over the video, at the estimated camera and clock offset."),
            picture(images.robot_sheet(results), "robot model over the video"),
            _render_fixed_cameras(results),
        ],
        "Motion": motion_section(results),
        "Replay": [
            paragraph(
                "The video (above) and the twin's replay of it (below). Surfaces that the scan does not show remain empty."
            ),
            picture(images.replay_sheet(results), "replay"),
        ],
    }


def _warnings(results: Results) -> list[str]:
    """Write the table of the stages' warnings; empty without any."""
    rows: list[list[object]] = [
        [stage.title, sentence] for stage in STAGES for sentence in manifest_of(results, stage.name).warnings
    ]
    return [table(["stage", "warning"], rows)] if rows else []


def _coverage(results: Results) -> str:
    rows: list[list[object]] = [
        [side, *(read_figure("coverage", name, seen[name]).number for name in FIGURES["coverage"])]
        for side, seen in manifest_of(results, "parts").figures["coverage"].items()
    ]
    return table(["side", *_titles("coverage")], rows)


def _render_fixed_cameras(results: Results) -> str:
    rows: list[list[object]] = []
    for name, item in results.alignment.cameras.items():
        clock = {"offset_s": item.clock.offset_s, "sd_s": item.clock.sd_s} if item.clock else {}
        figures = clock | item.figures
        shown = [
            read_figure("camera", key, figures[key]).number if key in figures else "unknown"
            for key in FIGURES["camera"]
        ]
        rows.append([name, *shown, item.note])
    return table(["camera", *_titles("camera"), "pose"], rows)


def _titles(group: str) -> list[str]:
    return [read_figure(group, name, 0.0).title for name in FIGURES[group]]


def contact_sheet(results: Results) -> np.ndarray:
    """Arrange a few frames from each camera: one row for the recording, and one for each of the first episodes."""
    folders = list_committed(results.folders["episodes"])[:SHEET_EPISODES]
    cameras = read_episode(folders[0]).episode.cameras
    names = list(cameras)
    size = cameras[names[0]]
    frames = [
        resize(image, size.width, size.height)
        for image in images.demo_strip(results, SHEET_FRAMES * len(names))
    ]
    for folder in folders:
        for name in names:
            frames += images.episode_strip(folder, name, SHEET_FRAMES)
    small = [resize(image, size.width // 2, size.height // 2) for image in frames]
    return sheet(small, SHEET_FRAMES * len(names), gap=2)


def results_table(results: Results) -> str:
    """Write the most important figures with their limits."""
    rows: list[list[object]] = []
    for stage, names in HEADLINES:
        figures = manifest_of(results, stage).figures
        chosen = {name: figures[name] for name in names if name in figures}
        rows += [_reading_row(item) for item in read_figures(stage, chosen)]
    return table(["result", "", ""], rows)


def provenance_table(results: Results) -> str:
    """Write version, date, seed and command of a run, and how to repeat it."""
    record = reuse(results.out / RUN_RECORD, partial(load_record, results.out))
    project = results.project
    rows: list[list[object]] = [
        ["AOMGen", record.version if record else __version__],
        ["finished", record.finished.replace("T", " ") if record else "not recorded"],
        ["command", _code(record.command) if record else "not recorded"],
        ["again", _code(shlex.join(["aomgen", "run", _project_file(results)]))],
        # A seed is a name, so it is aligned to the left, like the other values.
        ["seed", Markup(text(project.seed))],
        ["recording", str(project.capture)],
        ["assets", ", ".join(project.assets)],
    ]
    return table(["made with", ""], rows)


def stages_table(results: Results) -> str:
    """Write the duration of each stage, its share of the total, and its figures."""
    seconds = reuse_object(results.out / TIMINGS)
    total = max(sum(seconds.values()), 1e-9)
    rows: list[list[object]] = []
    for stage in STAGES:
        spent = float(seconds.get(stage.name, 0.0))
        items = read_figures(stage.name, manifest_of(results, stage.name).figures)
        figures = Markup("; ".join(reading(item) for item in items))
        rows.append([stage.title, f"{spent:.1f}", f"{100 * spent / total:.0f}", bar(spent / total), figures])
    head = ["stage", "seconds", "% of all", Markup('<div style="width:130px"></div>'), "figures"]
    return table([*head], [*rows, ["all", f"{total:.1f}", "100", "", ""]])


def next_steps(results: Results) -> list[str]:
    """Return commands for further work with this run."""
    out = shlex.quote(str(results.out.resolve()))
    project = shlex.quote(_project_file(results))
    camera = next(iter(results.episode_scene.cameras))
    halfway = 0.5 * float(results.motion.thetas.max())
    usd = sorted((results.folders["replacement"] / "assets").glob("*/asset.usda"))
    steps = [
        heading("More episodes, other assets"),
        paragraph(
            f"{PROJECT_FILE} contains all settings, such as the number of episodes and the assets "
            "(category:seed or paths "
            "of USD files). The recording is not reconstructed again."
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
    """Read the manifest of a finished stage.

    Raises:
        MissingFileError: The stage is not finished.
    """
    manifest = read_manifest(results.folders[stage])
    if manifest is None:
        raise MissingFileError(results.folders[stage], "is not finished", "run the project first")
    return manifest


def _reading_row(item: Reading) -> list[object]:
    judged = f"poor, {item.limit}" if item.verdict == "poor" else item.limit
    limit = Markup(f'<span class="{item.verdict}">{text(judged)}</span>')
    return [item.name, Markup(text(item.value)), limit]


def _project_file(results: Results) -> str:
    return str(results.out.resolve() / PROJECT_FILE)


def _code(words: str) -> Markup:
    return Markup(f"<code>{text(words)}</code>")
