"""`report.html`: what a run recovered and made, in images and numbers."""

from pathlib import Path

import numpy as np

from aomgen.io.atomic import write_text
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.images import write_image
from aomgen.pipeline.figures import FIGURES, read_figure
from aomgen.pipeline.project_file import read_project
from aomgen.pipeline.stage import results_of
from aomgen.pipeline.stages import PROJECT_FILE, REPORT_FILE, STAGES
from aomgen.report import recording_images
from aomgen.report.drawing import sheet
from aomgen.report.episodes import episodes_section
from aomgen.report.html import contents, page, paragraph, picture, section, table, text
from aomgen.report.motion_section import motion_section
from aomgen.report.rejects import rejects_section
from aomgen.report.summary import (
    manifest_of,
    next_steps,
    provenance_table,
    results_table,
    stages_table,
)
from aomgen.results import Results

CONTACT_SHEET = "episodes.jpg"
SHEET_FRAMES, SHEET_EPISODES = 5, 12


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
                sheet(recording_images.demo_strip(results, SHEET_FRAMES), SHEET_FRAMES),
                "The recorded demonstration.",
            ),
            *episodes_section(results),
        ],
        "Rejected poses": rejects_section(results),
        "What next": next_steps(results),
        **_recovered_sections(results),
        "Time and figures of the stages": [stages_table(results)],
    }
    shown = {title: parts for title, parts in sections.items() if parts}
    name = f"{results.recorded.name}: {results.recorded.instruction}"
    body = [
        f"<h1>{text(name)}</h1>",
        contents(list(shown)),
        f'<div class="head"><div>{results_table(results)}</div><div>{provenance_table(results)}</div></div>',
        *(section(title, *parts) for title, parts in shown.items()),
    ]
    write_text(out / REPORT_FILE, page(f"AOMGen: {results.recorded.name}", body))
    return out / REPORT_FILE


def _recovered_sections(results: Results) -> dict[str, list[str]]:
    """What the recording became, from the scan to the replay of the video."""
    return {
        "Scene": [
            paragraph("Held-out scan images (above) and the twin drawn from the same places (below)."),
            picture(recording_images.heldout_sheet(results), "held-out views"),
            paragraph("Part labels: robot blue, static part orange, moving part pink."),
            picture(recording_images.parts_sheet(results), "parts"),
        ],
        "Coverage": [
            paragraph(
                "Where the scan looked: sides of object, robot and table from above, with the scan's cameras. Green: "
                "enough views from different directions. Yellow: too few. Red: none; what is there is guessed."
            ),
            picture(recording_images.coverage_map(results), "coverage"),
            _coverage(results),
        ],
        "Alignment": [
            paragraph("The robot model's outline over the video, at the estimated camera and clock offset."),
            picture(recording_images.robot_sheet(results), "robot model over the video"),
            _fixed_cameras(results),
        ],
        "Motion": motion_section(results),
        "Replay": [
            paragraph(
                "The video (above) and the twin's replay of it (below). What the scan never saw stays empty."
            ),
            picture(recording_images.replay_sheet(results), "replay"),
        ],
    }


def _warnings(results: Results) -> list[str]:
    """What the stages warn of, or nothing."""
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


def _fixed_cameras(results: Results) -> str:
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
    """One row for the recording, one for each of the first episodes: a few frames from each camera."""
    folders = list_committed(results.folders["episodes"])[:SHEET_EPISODES]
    cameras = read_episode(folders[0]).episode.cameras
    names = list(cameras)
    size = cameras[names[0]]
    images = [
        recording_images.resize(image, size.width, size.height)
        for image in recording_images.demo_strip(results, SHEET_FRAMES * len(names))
    ]
    for folder in folders:
        for name in names:
            images += recording_images.episode_strip(folder, name, SHEET_FRAMES)
    small = [recording_images.resize(image, size.width // 2, size.height // 2) for image in images]
    return sheet(small, SHEET_FRAMES * len(names), gap=2)
