"""The list of all stages, and the functions that run them."""

import importlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from aomgen.assets.choice import asset_file
from aomgen.capture.label_images import demo_mask_files
from aomgen.capture.read import read_capture
from aomgen.capture.scan_poses import SCAN_POSES_FILE
from aomgen.core.progress import Progress
from aomgen.core.project import Project, split_light
from aomgen.core.recording import CAPTURE_FILE, Recording
from aomgen.errors import ConfigError, MissingFileError, OutdatedRunError, suggest
from aomgen.io.review import read_reviews
from aomgen.io.schema import override
from aomgen.pipeline.manifest import files_digest, read_manifest, text_digest
from aomgen.pipeline.preflight import preflight
from aomgen.pipeline.project_file import read_project, write_project
from aomgen.pipeline.runner import Display, Stage, StageFunction, lock, run_stages, stage_states
from aomgen.ray_cluster import require_cluster
from aomgen.results import Results
from aomgen.store import require_store

PROJECT_FILE = "project.toml"
REPORT_FILE = "report.html"
# Module below `aomgen` and class of the parameters, for each stage that has parameters.
PARAMETERS = {
    "structure": ("structure.reconstruct", "StructureParams"),
    "gaussians": ("gaussians.train", "GaussiansParams"),
    "alignment": ("alignment.align", "AlignmentParams"),
    "motion": ("motion.estimate", "MotionParams"),
    "replacement": ("replacement.fitting", "FitParams"),
    "episodes": ("episodes.parameters", "GenerationParams"),
    "dataset": ("datasets.stage", "DatasetParams"),
}


def _lazily(module: str, name: str = "run") -> StageFunction:
    """Make a stage function that imports its module below `aomgen` when it runs, so that finished runs open quickly."""

    def function(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
        return getattr(importlib.import_module(f"aomgen.{module}"), name)(results, folder, progress)

    return function


def _by_method(setting: str, functions: Mapping[str, StageFunction]) -> StageFunction:
    """Make a stage function that runs the method that a setting of the project selects."""

    def function(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
        return functions[getattr(results.project, setting)](results, folder, progress)

    return function


def _parts(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run the stage "parts", with the motion as evidence for the moving part."""
    from aomgen.motion.stage import motion_evidence

    project = results.project
    if project.alignment_method == "paper" or project.parts_method == "saga":
        from aomgen.paper.methods import run_parts as run
    else:
        from aomgen.parts.stage import run
    return run(results, folder, progress, partial(motion_evidence, results))


def _forget_episodes(folder: Path, names: list[str]) -> None:
    from aomgen.episodes.ledger import forget_files

    forget_files(folder, names)


STAGES: tuple[Stage, ...] = (
    Stage(
        name="structure",
        folder="01_structure",
        title="structure from motion",
        needs=("capture",),
        version=7,
        weight=40,
        function=_lazily("structure.stage"),
        incremental=True,
    ),
    Stage(
        name="gaussians",
        folder="02_gaussians",
        title="training Gaussians",
        needs=("capture", "structure"),
        settings=("iterations", "gaussians"),
        version=7,
        weight=76,
        function=_lazily("gaussians.stage"),
        incremental=True,
    ),
    Stage(
        name="alignment",
        folder="03_alignment",
        title="aligning scene and robot, clock",
        needs=("capture", "structure", "gaussians"),
        settings=("alignment_method",),
        version=10,
        weight=17,
        function=_by_method(
            "alignment_method",
            {"outlines": _lazily("alignment.stage"), "paper": _lazily("paper.methods", "run_alignment")},
        ),
    ),
    Stage(
        name="parts",
        folder="04_parts",
        title="parts of robot and object",
        needs=("capture", "structure", "gaussians", "alignment"),
        settings=("parts_method", "segmenter", "alignment_method"),
        version=16,
        weight=22,
        function=_parts,
        incremental=True,
    ),
    Stage(
        name="motion",
        folder="05_motion",
        title="keyframes, contact, joint",
        needs=("capture", "structure", "gaussians", "alignment", "parts"),
        settings=("motion_method",),
        version=29,
        weight=9,
        function=_by_method(
            "motion_method",
            {"aomotion": _lazily("motion.stage"), "paper": _lazily("paper.methods", "run_motion")},
        ),
    ),
    Stage(
        name="twin",
        folder="06_twin",
        title="binding the twin",
        needs=("capture", "structure", "gaussians", "alignment", "parts", "motion"),
        version=14,
        weight=24,
        function=_lazily("appearance.stage"),
    ),
    Stage(
        name="replacement",
        folder="07_replacement",
        title="removing the object, fitting assets",
        needs=("capture", "assets", "structure", "alignment", "motion", "twin"),
        settings=("assets", "adapt", "light", "light_yaw_deg", "inpainter", "seed", "image_size"),
        version=22,
        weight=11,
        function=_lazily("replacement.stage"),
    ),
    Stage(
        name="episodes",
        folder="08_episodes",
        title="episodes: new poses, physics, images",
        needs=("capture", "motion", "twin", "replacement"),
        settings=("seed", "poses"),
        version=23,
        weight=29,
        function=_lazily("episodes.stage"),
        incremental=True,
        amount=("poses",),
        forget=_forget_episodes,
        bulky=True,
    ),
    Stage(
        name="dataset",
        folder="dataset",
        title="LeRobot dataset",
        needs=("episodes", "review"),
        version=6,
        weight=2,
        function=_lazily("datasets.stage"),
        bulky=True,
    ),
)


def check_params(project: Project) -> None:
    """Check the parameters of stages in a project.

    Raises:
        ConfigError: A stage or parameter is unknown, or a value has the wrong type.
    """
    for stage, changes in project.params.items():
        if stage not in PARAMETERS:
            raise ConfigError(f"parameters of '{stage}'", "are unknown", suggest(stage, PARAMETERS))
        module, name = PARAMETERS[stage]
        kind = getattr(importlib.import_module(f"aomgen.{module}"), name)
        override(kind(), changes, stage)


def run_pipeline(project: Project, display: Display, *, until: str = "", **machine: Any) -> list[str]:
    """Check the project, then bring every stage up to date; return the names of the recomputed stages.

    Args:
        project: Settings of the run.
        display: Receives the progress.
        until: Last stage to run; all stages are run if it is empty.
        **machine: Fields `workers`, `ray` and `store` of `Results`, which state where episodes are generated.

    Raises:
        ConfigError: `until` is not the name of a stage.
        AomgenError: The recording, the project or the machine cannot be used, in which case no stage was started; or a stage
            failed.
    """
    names = [stage.name for stage in STAGES]
    if until and until not in names:
        raise ConfigError("--until", f"'{until}' is not a stage", suggest(until, names))
    check_params(project)
    wanted = STAGES[: names.index(until) + 1] if until else STAGES
    if "episodes" in [stage.name for stage in wanted]:
        for key, require in (("ray", require_cluster), ("store", require_store)):
            if machine.get(key):
                require(machine[key])
    capture = read_capture(project.capture)
    inputs = {"capture": capture_digest(capture), "assets": assets_digest(project.assets, project.light)}
    # The review file is read here, so that damage to it is reported before the run begins; preflight does not depend on it.
    review = {"review": rejections_digest(project.out)}
    for sentence in preflight(project, capture, inputs, wanted):
        # Warnings about the input are shown at the first stage, which reads it.
        display.warn(STAGES[0], sentence)
    # The project is stored with the results, so that reports can be made again.
    with lock(project.out):
        write_project(project.out / PROJECT_FILE, project)
    with _fit_assets_early(project, wanted):
        return run_stages(project, STAGES, display, inputs=inputs | review, until=until, **machine)


@contextmanager
def _fit_assets_early(project: Project, wanted: Sequence[Stage]) -> Iterator[None]:
    """Fit the Gaussians of the assets on idle cores while earlier stages run, if a later stage needs them.

    Assets that are scaled to the recorded motion are not known before it is estimated.
    """
    states = {stage.name: state for stage, state in stage_states(project, tuple(wanted))}
    if (
        project.adapt != "trajectory"
        or states.get("replacement", "done") == "done"
        or states["structure"] == "done"
    ):
        yield
        return
    from aomgen.replacement.surfel_cache import fit_in_background

    with fit_in_background(project.assets):
        yield


def require_stage(results: Results, name: str) -> None:
    """Check that a stage of a run has finished with the current version of the stage.

    Raises:
        MissingFileError: The stage has not finished.
        OutdatedRunError: The result is of another version; the message states the command that brings it up to date.
    """
    stage = next(stage for stage in STAGES if stage.name == name)
    manifest = read_manifest(results.folders[name])
    if manifest is None:
        raise MissingFileError(
            results.out, f"has no result of stage '{name}'", f"finish it with `aomgen run {results.out}`"
        )
    if manifest.version != stage.version:
        raise OutdatedRunError(results.out, name, manifest.version, stage.version)


def find_project(path: Path) -> Project:
    """Read a project from a project file, or from the folder of a run, which may have been moved.

    Raises:
        MissingFileError: The path does not exist, or is a folder without a run.
        ConfigError: The project file is not valid.
    """
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


def capture_digest(capture: Recording) -> str:
    """Compute the digest of a capture's capture.toml and all files to which it refers."""
    files: list[Path] = [capture.folder / CAPTURE_FILE, *capture.scan_images]
    if capture.scan_video is not None:
        files.append(capture.scan_video)
    if capture.scan_poses is not None:
        files.append(capture.scan_images[0].parent / SCAN_POSES_FILE)
    files += [camera.video for camera in capture.cameras]
    for camera in capture.cameras:
        files += demo_mask_files(capture, camera)
    files += sorted((capture.folder / "demo").glob("*.csv"))
    if capture.robot.model_file:
        files += [capture.robot.model_file, *capture.robot.references]
    for masks in capture.mask_folders.values():
        files += sorted(masks.glob("*.png"))
    return files_digest(files)


def assets_digest(specs: Sequence[str], light: str) -> str:
    """Compute the digest of a project's USD files, without the files to which they refer, and of the file of its light."""
    found = [named[0] for named in map(asset_file, specs) if named is not None]
    found.append(Path(split_light(light)[1]))
    return files_digest([file for file in found if file.is_file()])


def rejections_digest(out: Path) -> str:
    """Compute the digest of the episodes that a person has rejected; if it changes, the dataset is written again.

    Raises:
        MalformedFileError: The review file is damaged.
    """
    reviews = sorted(read_reviews(out).items())
    rejected = (f"{number} {item.content}" for number, item in reviews if item.decision == "rejected")
    return text_digest("\n".join(rejected))
