"""Read and write the project file, which states the settings of a run."""

import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from aomgen.core.project import Project, split_light
from aomgen.errors import ConfigError, MissingFileError
from aomgen.io.atomic import write_text
from aomgen.io.schema import complaint, flatten, format_toml_value

TEMPLATE = """\
# Settings of an AOMGen run. Start it with `aomgen run project.toml`.
format = 1
capture = {capture}    # folder with capture.toml
out = {out}    # folder for the results

seed = {seed}    # the same seed gives the same episodes
# Each asset is "category:seed" (a parametric asset), the path of a USD file, or "original" (the recorded object).
assets = {assets}
poses = {poses}    # number of verified episodes for each asset
# "trajectory": assets keep their size; "object": they are scaled to the recorded motion; "auto": scaled if that fits.
adapt = {adapt}
light = {light}    # light on new objects: "scan", the path of an HDRI (.hdr), or "diffusion:FOLDER"
light_yaw_deg = {light_yaw_deg}    # rotation of the HDRI about the vertical axis [deg], counterclockwise from above
inpainter = {inpainter}    # unobserved parts of the table: "" (texture synthesis) or folder of a diffusion pipeline

image_size = {image_size}    # width and height of the episodes' images [px]
iterations = {iterations}    # training steps of the scene's Gaussians
gaussians = {gaussians}    # largest number of Gaussians of the scene
segmenter = {segmenter}    # "auto" (masks of the capture, or else MobileSAM), or the name of SAM 2 weights
alignment_method = {alignment_method}    # "outlines", or for comparison "paper" (rigid ICP and link boxes)
motion_method = {motion_method}    # "aomotion", or for comparison "paper" (its four estimators as printed)
parts_method = {parts_method}    # "closed_form", or "saga" (affinity features; takes minutes longer)
"""


def read_project(path: Path) -> Project:
    """Read a project file; relative paths refer to its folder.

    Raises:
        MissingFileError: The file does not exist.
        ConfigError: The file is not TOML, or it has an unknown key or a value outside its range.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "write one with `aomgen init CAPTURE`")
    try:
        data: dict[str, Any] = tomllib.loads(path.read_text("utf-8-sig"))
        project = Project.model_validate(data)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(path, f"is not valid TOML ({error})", "correct that line") from error
    except ValidationError as error:
        raise ConfigError(path, *complaint(error, Project)) from error
    base = path.parent.resolve()
    assets = tuple(str((base / item).resolve()) if Path(item).suffix else item for item in project.assets)
    head, light = split_light(project.light)
    return project.model_copy(
        update={
            "capture": (base / project.capture).resolve(),
            "out": (base / project.out).resolve(),
            "assets": assets,
            "light": head + str((base / light).resolve()) if light else head,
            "inpainter": project.inpainter and str((base / project.inpainter).resolve()),
        }
    )


def write_project(path: Path, project: Project) -> None:
    """Write a project file with all settings and a comment on each.

    Paths below the folder of the file are written relative to it, so that the folder can be moved.

    Raises:
        ConfigError: A path is not Unicode text.
        StorageError: Writing to the disk failed.
    """
    base = path.parent.resolve()
    values = project.model_dump(mode="json")
    values["capture"], values["out"] = (_below(base, item) for item in (project.capture, project.out))
    values["assets"] = [
        _below(base, Path(item)) if Path(item).is_absolute() else item for item in project.assets
    ]
    head, light = split_light(project.light)
    values["light"] = head + _below(base, Path(light)) if light else head
    values["inpainter"] = project.inpainter and _below(base, Path(project.inpainter))
    params = flatten(values.pop("params"))
    text = TEMPLATE.format(**{name: format_toml_value(value) for name, value in values.items()})
    if params:
        text += "\n[params]\n" + "".join(
            f"{name} = {format_toml_value(value)}\n" for name, value in params.items()
        )
    write_text(path, text)


def _below(base: Path, path: Path) -> str:
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else str(path)
