"""The project file: every choice of a run, spelled out, on disk."""

import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from aomgen.core.project import Project, split_light
from aomgen.errors import ConfigError, MissingFileError
from aomgen.io.atomic import write_text
from aomgen.io.schema import complaint, flatten, format_toml_value

TEMPLATE = """\
# AOMGen project: what to make out of one capture. Run it with `aomgen run project.toml`.
format = 1
capture = {capture}          # folder with capture.toml
out = {out}                  # where results go

seed = {seed}                  # same seed, same episodes
assets = {assets}              # category:seed of a made asset, the path of a USD file, or "original"
poses = {poses}                # verified episodes wanted for each asset
adapt = {adapt}              # "trajectory": the asset keeps its size; "object": it is scaled to the motion; "auto": scaled where that fits
light = {light}              # of new objects: "scan", or the path of an HDRI (.hdr), or "diffusion:FOLDER"
light_yaw_deg = {light_yaw_deg}       # turn of an HDRI about the vertical, counterclockwise from above
inpainter = {inpainter}            # of what nobody saw of the table: "" for patches, or the folder of a diffusion pipeline

image_size = {image_size}      # width and height of the episodes' images [px]
iterations = {iterations}      # training steps of the scene's Gaussians
gaussians = {gaussians}        # cap on their number
segmenter = {segmenter}    # "auto": the capture's masks, else MobileSAM; or the name of SAM 2 weights
alignment_method = {alignment_method}    # "outlines", or "paper": rigid ICP and link boxes, to compare with
motion_method = {motion_method}    # "aomotion", or "paper": its four estimators as printed, to compare with
parts_method = {parts_method}    # "closed_form", or "saga" for affinity features (minutes more)
"""


def read_project(path: Path) -> Project:
    """Load a project file; relative paths are taken from its folder.

    Raises:
        MissingFileError: No such file.
        ConfigError: Not TOML, an unknown key, a value outside its range.
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
    """Write a project file with every choice and a comment on it.

    What lies below the file's folder is named relative to it, so that both can be moved together.

    Raises:
        ConfigError: A path is not Unicode text.
        StorageError: The disk refuses.
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
