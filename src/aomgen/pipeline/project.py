"""The project file: every choice of a run, spelled out."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aomgen.errors import ConfigError, MissingFileError
from aomgen.io.atomic import write_text

TEMPLATE = """\
# AOMGen project: what to make out of one capture. Run it with `aomgen run project.toml`.
format = 1
capture = {capture!r}          # folder with capture.toml
out = {out!r}                  # where results go

seed = {seed}                  # same seed, same episodes
assets = {assets}              # category:seed of a made asset, or the path of a USD file
poses = {poses}                # verified episodes wanted for each asset
adapt = {adapt!r}              # "trajectory": the asset keeps its size; "object": it is scaled to the motion

image_size = {image_size}      # width and height of the episodes' images [px]
iterations = {iterations}      # training steps of the scene's Gaussians
gaussians = {gaussians}        # cap on their number
segmenter = {segmenter!r}    # "auto": the capture's masks, else MobileSAM; or the name of SAM 2 weights
alignment_method = {alignment_method!r}    # "outlines", or "paper": rigid ICP and link boxes, to compare with
motion_method = {motion_method!r}    # "aomotion", or "paper": its four estimators as printed, to compare with
parts_method = {parts_method!r}    # "closed_form", or "saga" for affinity features (minutes more)
"""


class Project(BaseModel):
    """Choices of one run; paths are absolute after loading.

    Attributes:
        capture: Folder of the capture.
        out: Folder of the results.
        seed: Seed of everything random from the twin onwards.
        assets: Assets that replace the object, `category:seed` or a USD path.
        poses: Verified episodes wanted for each asset.
        adapt: How asset and motion are brought together; see `replacement.fitting`.
        image_size: Size of the episodes' images, [px].
        iterations: Training steps.
        gaussians: Cap on the number of Gaussians in the scene.
        segmenter: What makes masks; see `reconstruction.masks.segmenter.choose_segmenter`.
        alignment_method: How scan and robot are brought together; "paper" is there to compare with.
        motion_method: How the part's motion is recovered; "paper" is there to compare with.
        parts_method: How the object's parts are found; see `reconstruction.parts`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    capture: Path
    out: Path
    seed: int = Field(default=0, ge=0)
    assets: tuple[str, ...] = Field(default=(), min_length=0)
    poses: int = Field(default=6, ge=1, le=10_000)
    adapt: Literal["trajectory", "object"] = "trajectory"
    image_size: tuple[Annotated[int, Field(ge=64, le=4096)], Annotated[int, Field(ge=64, le=4096)]] = (
        320,
        240,
    )
    iterations: int = Field(default=1200, ge=10, le=200_000)
    gaussians: int = Field(default=100_000, ge=1_000, le=3_000_000)
    segmenter: str = Field(default="auto", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    alignment_method: Literal["outlines", "paper"] = "outlines"
    motion_method: Literal["aomotion", "paper"] = "aomotion"
    parts_method: Literal["closed_form", "saga"] = "closed_form"


def read_project(path: Path) -> Project:
    """Load a project file; relative paths are taken from its folder.

    Raises:
        MissingFileError: No such file.
        ConfigError: Not TOML, an unknown key, a value outside its range.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "write one with `aomgen init CAPTURE`")
    try:
        data: dict[str, Any] = tomllib.loads(path.read_text("utf-8"))
        project = Project.model_validate(data)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(path, f"is not valid TOML ({error})", "correct that line") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(item) for item in first["loc"])
        known = ", ".join(sorted(Project.model_fields))
        raise ConfigError(path, f"'{key}': {first['msg']}", f"known keys: {known}") from error
    base = path.parent.resolve()
    assets = tuple(str((base / item).resolve()) if Path(item).suffix else item for item in project.assets)
    return project.model_copy(
        update={
            "capture": (base / project.capture).resolve(),
            "out": (base / project.out).resolve(),
            "assets": assets,
        }
    )


def write_project(path: Path, project: Project) -> None:
    """Write a project file with every choice and a comment beside it."""
    values = project.model_dump()
    values["capture"], values["out"] = str(project.capture), str(project.out)
    values["assets"], values["image_size"] = list(project.assets), list(project.image_size)
    write_text(path, TEMPLATE.format(**values))
