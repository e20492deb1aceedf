"""`report.html`: what a run recovered and made, in pictures and numbers."""

from pathlib import Path
from typing import Any

import numpy as np

from aomgen.errors import MissingFileError
from aomgen.io.atomic import write_text
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.images import write_image
from aomgen.io.jsonfile import read_json
from aomgen.pipeline.manifest import read_manifest
from aomgen.pipeline.project import read_project
from aomgen.pipeline.runner import TIMINGS
from aomgen.pipeline.stage import Run
from aomgen.pipeline.stages import PROJECT_FILE, REPORT_FILE, STAGES
from aomgen.report import pictures
from aomgen.report.drawing import sheet
from aomgen.report.html import page, paragraph, picture, section, table
from aomgen.report.motion import motion_section

CONTACT_SHEET = "episodes.jpg"
SHEET_FRAMES = 5


def write_report(out: Path) -> Path:
    """Write `report.html` and the contact sheet of a finished run.

    Returns:
        Path of the report.

    Raises:
        MissingFileError: The run is not finished.
    """
    project = read_project(out / PROJECT_FILE)
    run = Run(project=project, out=out, folders={stage.name: out / stage.folder for stage in STAGES})
    if read_manifest(run.folders["dataset"]) is None:
        raise MissingFileError(run.folders["dataset"], "is not finished", "run the project first")
    data = pictures.open_recovered(run)
    contact_sheet = _contact_sheet(data)
    write_image(out / CONTACT_SHEET, contact_sheet)
    body = [
        f"<h1>{data.capture.name}: {data.capture.instruction}</h1>",
        _summary(run),
        _warnings(run),
        section(
            "Generated episodes",
            _episodes_text(run),
            picture(
                contact_sheet,
                "Top row: the recording. Below: one "
                "row an episode, from the recording camera and from the new viewpoint.",
            ),
        ),
        section("Verdicts", _verdicts(run)),
        section(
            "Scene",
            paragraph("Held-out scan images (above) and the twin drawn from the same places (below)."),
            picture(pictures.heldout_sheet(data), "held-out views"),
            paragraph("Part labels: robot blue, static part orange, moving part pink."),
            picture(pictures.parts_sheet(data), "parts"),
        ),
        section(
            "Coverage",
            paragraph(
                "Where the scan looked: sides of object, robot and table from above, with the scan's cameras. Green: "
                "enough views from different directions. Yellow: too few. Red: none; what is there is guessed."
            ),
            picture(pictures.coverage_map(data), "coverage"),
            _coverage(run),
        ),
        section(
            "Alignment",
            paragraph("The robot model's outline over the video, at the estimated camera and clock offset."),
            picture(pictures.robot_sheet(data), "robot model over the video"),
        ),
        section("Motion", *motion_section(data)),
        section(
            "Replay",
            paragraph(
                "The video (above) and the twin's replay of it (below). What the scan never saw stays empty."
            ),
            picture(pictures.replay_sheet(data), "replay"),
        ),
        section("Stages", _stages(run)),
    ]
    write_text(out / REPORT_FILE, page(f"AOMGen: {data.capture.name}", body))
    return out / REPORT_FILE


def _summary(run: Run) -> str:
    figures = {stage.name: _figures(run, stage.name) for stage in STAGES}
    return table(
        ["result", ""],
        [
            ["episodes, all verified", figures["episodes"]["episodes"]],
            ["frames in the dataset", figures["dataset"]["frames"]],
            ["held-out PSNR [dB]", figures["gaussians"]["heldout_psnr"]],
            ["end effector, standard deviation [mm]", figures["alignment"]["end_effector_sd_mm"]],
            ["clock offset [s]", figures["motion"]["clock_offset_s"]],
            ["joint", figures["motion"]["joint"]],
        ],
    )


def _warnings(run: Run) -> str:
    """What the stages warn of, or nothing."""
    rows: list[list[object]] = []
    for stage in STAGES:
        manifest = read_manifest(run.folders[stage.name])
        for sentence in manifest.warnings if manifest else ():
            rows.append([stage.title, sentence])
    return section("Warnings", table(["stage", "warning"], rows)) if rows else ""


def _coverage(run: Run) -> str:
    rows: list[list[object]] = []
    for name, seen in _figures(run, "parts")["coverage"].items():
        rows.append([name, seen["views"], seen["spread_deg"], 100 * seen["share"]])
    return table(["side", "views (median)", "spread [deg]", "seen enough [%]"], rows)


def _contact_sheet(data: pictures.Recovered) -> np.ndarray:
    """One row for the recording, one an episode: a few frames from each camera."""
    folders = list_committed(data.run.folders["episodes"])
    names = list(read_episode(folders[0]).episode.cameras)
    size = read_episode(folders[0]).episode.cameras[names[0]]
    images = [
        pictures.resize(image, size.width, size.height)
        for image in pictures.demo_strip(data, SHEET_FRAMES * len(names))
    ]
    for folder in folders:
        for name in names:
            images += pictures.episode_strip(folder, name, SHEET_FRAMES)
    small = [pictures.resize(image, size.width // 2, size.height // 2) for image in images]
    return sheet(small, SHEET_FRAMES * len(names), gap=2)


def _episodes_text(run: Run) -> str:
    figures = _figures(run, "plans")
    return paragraph(
        f"{figures['verified']} variations passed and {figures['rejected']} were rejected. An episode passes when "
        "contact alone moves the passive joint to at least 90 % of the planned value under all settings of damping "
        "and friction."
    )


def _verdicts(run: Run) -> str:
    rows = []
    for folder in list_committed(run.folders["episodes"]):
        episode = read_episode(folder).episode
        runs = episode.verdict["dynamic"]
        rows.append(
            [
                folder.name,
                episode.asset,
                min(item["target_share"] for item in runs),
                min(item["contact_share"] for item in runs),
                max(item["tracking_mm"] for item in runs),
                max(item["peak_force_n"] for item in runs),
                episode.verdict["grasp"],
            ]
        )
    header = [
        "episode",
        "asset",
        "share of target",
        "share in contact",
        "tracking [mm]",
        "peak force [N]",
        "grasp",
    ]
    rejected = read_json(run.folders["plans"] / "rejected.json")
    reasons = [[reason, count] for reason, count in rejected["reasons"].items()]
    return table(header, rows) + (table(["rejected because", "variations"], reasons) if reasons else "")


def _stages(run: Run) -> str:
    seconds = read_json(run.out / TIMINGS)
    rows: list[list[object]] = []
    for stage in STAGES:
        shown = ", ".join(
            f"{name} {_short(value)}"
            for name, value in _figures(run, stage.name).items()
            if not isinstance(value, dict)
        )
        rows.append([stage.title, float(seconds.get(stage.name, 0.0)), shown])
    return table(["stage", "seconds", "figures"], [*rows, ["all", float(sum(seconds.values())), ""]])


def _figures(run: Run, name: str) -> dict[str, Any]:
    manifest = read_manifest(run.folders[name])
    return {} if manifest is None else manifest.figures


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
