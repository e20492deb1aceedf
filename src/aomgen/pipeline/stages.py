"""The one list of stages, and how it is run."""

import importlib
from pathlib import Path
from typing import Any

from aomgen.capture.demo_masks import demo_mask_files
from aomgen.capture.read import read_capture
from aomgen.core.progress import Progress
from aomgen.core.recording import Capture
from aomgen.errors import ConfigError
from aomgen.io.schema import suggest
from aomgen.pipeline.asset_choice import assets_digest
from aomgen.pipeline.manifest import files_digest
from aomgen.pipeline.preflight import preflight
from aomgen.pipeline.project import Project, write_project
from aomgen.pipeline.runner import Display, run_stages
from aomgen.pipeline.stage import Run, Stage, StageFunction

PROJECT_FILE = "project.toml"
REPORT_FILE = "report.html"


def lazily(module: str, name: str) -> StageFunction:
    """A stage function of a sibling module, imported when the stage runs.

    A finished run is looked through in a second that way, without torch or MuJoCo.
    """

    def function(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
        return getattr(importlib.import_module(f"aomgen.pipeline.{module}"), name)(run, folder, progress)

    return function


STAGES: tuple[Stage, ...] = (
    Stage(
        name="structure",
        folder="01_structure",
        title="structure from motion",
        needs=("capture",),
        settings=(),
        version=6,
        weight=40,
        function=lazily("twin_stages", "structure"),
        incremental=True,
    ),
    Stage(
        name="gaussians",
        folder="02_gaussians",
        title="training Gaussians",
        needs=("capture", "structure"),
        settings=("iterations", "gaussians"),
        version=4,
        weight=76,
        function=lazily("twin_stages", "gaussians"),
        incremental=True,
    ),
    Stage(
        name="alignment",
        folder="03_alignment",
        title="aligning scene and robot, clock",
        needs=("capture", "structure", "gaussians"),
        settings=("alignment_method",),
        version=8,
        weight=17,
        function=lazily("aligning", "alignment"),
    ),
    Stage(
        name="parts",
        folder="04_parts",
        title="parts of robot and object",
        needs=("capture", "structure", "gaussians", "alignment"),
        settings=("parts_method", "segmenter", "alignment_method"),
        version=12,
        weight=22,
        function=lazily("twin_stages", "parts"),
        incremental=True,
    ),
    Stage(
        name="motion",
        folder="05_motion",
        title="keyframes, contact, joint",
        needs=("capture", "structure", "gaussians", "alignment", "parts"),
        settings=("motion_method",),
        version=23,
        weight=9,
        function=lazily("twin_stages", "motion"),
    ),
    Stage(
        name="twin",
        folder="06_twin",
        title="binding the twin",
        needs=("capture", "structure", "gaussians", "alignment", "parts", "motion"),
        settings=(),
        version=8,
        weight=24,
        function=lazily("twin_stages", "twin"),
    ),
    Stage(
        name="replacement",
        folder="07_replacement",
        title="removing the object, fitting assets",
        needs=("capture", "assets", "structure", "alignment", "motion", "twin"),
        settings=("assets", "adapt", "seed", "image_size"),
        version=5,
        weight=10,
        function=lazily("generation", "replacement"),
    ),
    Stage(
        name="plans",
        folder="08_plans",
        title="new poses, verified in physics",
        needs=("capture", "motion", "twin", "replacement"),
        settings=("seed", "poses"),
        version=2,
        weight=12,
        function=lazily("generation", "plans"),
        incremental=True,
        amount=("poses",),
    ),
    Stage(
        name="episodes",
        folder="09_episodes",
        title="rendering episodes",
        needs=("capture", "replacement", "plans"),
        settings=(),
        version=6,
        weight=17,
        function=lazily("generation", "episodes"),
        incremental=True,
    ),
    Stage(
        name="dataset",
        folder="dataset",
        title="LeRobot dataset",
        needs=("episodes",),
        settings=(),
        version=2,
        weight=2,
        function=lazily("generation", "dataset"),
    ),
)


def run_pipeline(project: Project, display: Display, *, until: str = "") -> list[str]:
    """Check everything that can be known, then bring every stage up to date; the names of those made anew.

    Raises:
        ConfigError: `until` names no stage.
        AomgenError: Capture, project or machine cannot be used, and nothing was started; or whatever
            a stage refuses.
    """
    names = [stage.name for stage in STAGES]
    if until and until not in names:
        raise ConfigError("--until", f"'{until}' is no stage", suggest(until, names))
    wanted = STAGES[: names.index(until) + 1] if until else STAGES
    capture = read_capture(project.capture)
    inputs = {"capture": capture_digest(capture), "assets": assets_digest(project.assets)}
    for sentence in preflight(project, capture, inputs, wanted):
        # Warnings about the input appear where it is read first.
        display.warn(STAGES[0], sentence)
    # The choices lie beside the results, so that reports can be made again and questions answered.
    write_project(project.out / PROJECT_FILE, project)
    return run_stages(project, STAGES, display, inputs=inputs, until=until)


def capture_digest(capture: Capture) -> str:
    """Digest of everything that a capture's capture.toml refers to."""
    files: list[Path] = [capture.folder / "capture.toml", *capture.scan_images]
    if capture.scan_video is not None:
        files.append(capture.scan_video)
    files += [camera.video for camera in capture.cameras]
    for camera in capture.cameras:
        files += demo_mask_files(capture, camera)
    files += sorted((capture.folder / "demo").glob("*.csv"))
    if capture.robot.model_file:
        files += [capture.robot.model_file, *capture.robot.references]
    for masks in capture.mask_folders.values():
        files += sorted(masks.glob("*.png"))
    return files_digest(files)
