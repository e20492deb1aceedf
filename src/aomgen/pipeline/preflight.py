"""Check a project, its capture and this machine before a run starts."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from aomgen.assets.choice import is_made, make_asset, open_assets, resolve_asset, suggest_category
from aomgen.capture.capture_check import check_capture
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.project import Project, split_light
from aomgen.core.recording import CAPTURE_FILE, Recording
from aomgen.errors import BackendError, ConfigError, MissingFileError, StorageError, suggest
from aomgen.io.atomic import is_vacant, write_json
from aomgen.io.hdr_image import read_environment
from aomgen.io.reuse import reuse_object
from aomgen.io.video import probe_video
from aomgen.pipeline.manifest import MANIFEST, text_digest
from aomgen.pipeline.requirements import EVERYTHING, require_environment, require_room
from aomgen.pipeline.runner import STARTED, Stage, stage_states
from aomgen.robots.robot import RobotModel
from aomgen.version import __version__

# File in the folder of the results that holds the digest and the warnings of the last check, so that unchanged inputs are not
# checked again.
CHECKED_FILE = "checked.json"
# Default width of the images of episodes, [px].
IMAGE_WIDTH = 320
# Relative difference between the aspect ratios of episode images and camera above which distortion becomes visible.
MAX_STRETCH = 0.05
# Number of boxes around the robot in scan images that the alignment method "paper" requires.
PAPER_ROBOT_BOXES = 2
# Name of the file that diffusers writes to the folder of a pipeline.
DIFFUSION_INDEX = "model_index.json"
# Seeds of the assets that are made to find the joint types of a category; they include all joint types.
CATEGORY_SEEDS = range(4)
OPENS = {"revolute": "turns", "prismatic": "slides"}


def check_project(project: Project, capture: Recording) -> tuple[str, ...]:
    """Check a project and its capture, but not the machine, and return warnings.

    Raises:
        AomgenError: A problem would stop the run; only the first one is reported.
    """
    _check_cameras(project, capture)
    assets = open_assets(project.assets)
    _check_light(project.light)
    _check_networks(project.networks)
    require_room(project.out)
    robot, _, warnings = check_capture(capture)
    _check_robot_cameras(project, robot)
    return (
        *warnings,
        *_warn_of_distortion(project, capture),
        *_doubtful_joints(capture.category, assets),
    )


def preflight(
    project: Project, capture: Recording, inputs: Mapping[str, str], stages: Sequence[Stage]
) -> tuple[str, ...]:
    """Run `check_project` and `require_environment` before a run; unchanged inputs are not checked again.

    Args:
        project: Settings of the run.
        capture: Capture of the project.
        inputs: Digests of the capture and of the asset files, by name.
        stages: Stages that the run brings up to date.

    Returns:
        Warnings, including those of the earlier check if the inputs have not changed.

    Raises:
        AomgenError: A problem would stop the run.
    """
    for stage in stages:
        _require_own(project.out / stage.folder)
    file = project.out / CHECKED_FILE
    choices = project.model_dump_json(exclude={"capture", "out"})
    digest = text_digest("\n".join([__version__, choices, *inputs.values()]))
    known = reuse_object(file)
    same = known.get("digest") == digest
    warnings = tuple(known.get("warnings", ())) if same else check_project(project, capture)
    done = [stage.name for stage, state in stage_states(project, tuple(stages)) if state == "done"]
    missing = [stage.name for stage in stages if not (same and stage.name in done)]
    if missing:
        require_room(project.out)
        has_masks = bool(capture.mask_folders)
        networks = bool(project.networks)
        require_environment(missing, project.segmenter, has_masks=has_masks, diffusion=networks, repair=True)
    if not same:
        write_json(file, {"digest": digest, "warnings": warnings})
    return warnings


def machine_warnings(segmenter: str, capture: Recording, *, diffusion: bool = False) -> tuple[str, ...]:
    """Return a warning if this machine does not satisfy the requirements of a run.

    This is no error, because the run may be executed on another machine.

    Args:
        segmenter: Segmenter of the project.
        capture: Capture of the project.
        diffusion: The project uses diffusion pipelines.
    """
    try:
        require_environment(EVERYTHING, segmenter, has_masks=bool(capture.mask_folders), diffusion=diffusion)
    except BackendError as error:
        return (f"a run on this machine would stop: {error}",)
    return ()


def category_warnings(capture: Recording) -> tuple[str, ...]:
    """Return a warning of `aomgen init` if the capture's category is not parametric."""
    if is_made(capture.category):
        return ()
    return (
        f"{capture.folder / CAPTURE_FILE}: no asset of category '{capture.category}' can be made "
        f"({suggest_category(capture.category)}): correct it, or name assets with `aomgen init --asset`",
    )


def new_project(capture: Recording, out: Path, assets: Sequence[str]) -> Project:
    """Make a project for a capture; episode images have the aspect ratio of the first fixed camera.

    Args:
        capture: Capture of the project.
        out: Folder of the results.
        assets: Assets as named by the user, with file paths relative to the current folder; if there are none, two
            parametric assets of the capture's category are used.

    Raises:
        ConfigError: No assets are named, and the capture's category is not parametric.
    """
    if not assets and not is_made(capture.category):
        raise ConfigError(
            capture.folder / CAPTURE_FILE,
            f"no asset of category '{capture.category}' can be made",
            f"{suggest_category(capture.category)} Correct it, or name assets with --asset",
        )
    chosen = list(assets) or [f"{capture.category}:{seed}" for seed in (1, 2)]
    return Project(
        capture=capture.folder.resolve(),
        out=out.resolve(),
        assets=tuple(map(resolve_asset, chosen)),
        image_size=_fitting_size(capture, IMAGE_WIDTH),
    )


def _require_own(folder: Path) -> None:
    """Refuse to replace a folder with content that no run has written.

    Raises:
        StorageError: The folder has such content.
    """
    made = any((folder / name).is_file() for name in (MANIFEST, STARTED))
    if not is_vacant(folder) and not made:
        raise StorageError(
            folder,
            "was not created by a run, and this run would replace it",
            "move it away or choose another `out`",
        )


def _fitting_size(capture: Recording, width: int) -> tuple[int, int]:
    """Return width and even height, [px], of an image with the aspect ratio of the first fixed camera."""
    info = probe_video(capture.cameras[0].video)
    return width, max(64, 2 * round(width * info.height / info.width / 2))


def _check_cameras(project: Project, capture: Recording) -> None:
    path = capture.folder / CAPTURE_FILE
    if project.assets and capture.cameras[0].name == NEW_CAMERA:
        raise ConfigError(
            path,
            f"gives its first camera the name '{NEW_CAMERA}', which is reserved for the new viewpoint of the episodes",
            "give it another name",
        )
    boxes = sum(prompt.part == "robot" and len(prompt.box) == 4 for prompt in capture.prompts)
    if project.alignment_method == "paper" and not boxes >= PAPER_ROBOT_BOXES:
        raise ConfigError(
            path,
            f"has {boxes} box around the robot, alignment_method = 'paper' takes {PAPER_ROBOT_BOXES}",
            "add a robot prompt on another image",
        )
    known = (capture.cameras[0].name, NEW_CAMERA)
    for name in project.params.get("episodes", {}).get("cameras", ()):
        if name not in known:
            raise ConfigError("episodes.cameras", f"'{name}' is not a camera", suggest(str(name), known))


def _check_light(light: str) -> None:
    head, path = split_light(light)
    if not head:
        read_environment(Path(path))


def _check_networks(folders: Sequence[Path]) -> None:
    for folder in folders:
        if not (folder / DIFFUSION_INDEX).is_file():
            raise MissingFileError(
                folder / DIFFUSION_INDEX,
                "is missing",
                "save a diffusion pipeline there, see docs/replacement.md",
            )


def _check_robot_cameras(project: Project, robot: RobotModel) -> None:
    images = project.params.get("episodes", {}).get("images", {})
    if images.get("robot_cameras") and not robot.cameras:
        raise ConfigError(
            "episodes.images.robot_cameras",
            f"is true, but {robot.name} has no camera",
            "add [[camera]] to a robot.toml, or leave it out",
        )


def _warn_of_distortion(project: Project, capture: Recording) -> tuple[str, ...]:
    width, height = project.image_size
    fitting = _fitting_size(capture, width)
    stretch = abs(height / fitting[1] - 1)
    if not project.assets or stretch <= MAX_STRETCH:
        return ()
    return (
        f"image_size {width} x {height} stretches the camera's picture by {stretch:.0%}: "
        f"{fitting[0]} x {fitting[1]} keeps its shape",
    )


@cache
def _find_joint_types(category: str) -> frozenset[str]:
    """Make some assets of a category to find its joint types; this takes most of the time of a check."""
    return frozenset(make_asset(category, seed).joint.type for seed in CATEGORY_SEEDS)


def _doubtful_joints(category: str, assets: list[ArticulatedAsset]) -> tuple[str, ...]:
    """Return warnings about assets whose joint type the recorded object's category never has."""
    if not is_made(category):
        return ()
    types = _find_joint_types(category)
    if len(types) > 1:
        return ()
    usual = next(iter(types))
    return tuple(
        f"asset {asset.name} {OPENS[asset.joint.type]}, a {category} {OPENS[usual]}: stage replacement "
        "refuses assets that open another way than the recorded object"
        for asset in assets
        if asset.joint.type != usual
    )
