"""The schema of `capture.toml`, format 1."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from aomgen.errors import LimitExceededError, MalformedFileError, MissingFileError
from aomgen.io.schema import complaint

# Largest capture.toml read, [bytes]; a usual one has a few kB.
MAX_BYTES = 1 << 20
Four = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class HandSection(_Section):
    open: dict[str, FiniteFloat] = {}
    closed: dict[str, FiniteFloat] = {}
    fingers: list[str] = Field(default=[], max_length=2)
    ee_site: str = ""


class RobotSection(_Section):
    model: str = ""
    urdf: str = ""
    mjcf: str = ""
    joints: list[str] = Field(min_length=1)
    gripper: str = "gripper"
    base_frame: Literal["base_link", "ur_base"] = "base_link"
    scan_state: Literal["first_row"] | list[FiniteFloat] = "first_row"
    hand: HandSection = HandSection()


class ScanSection(_Section):
    images: str
    intrinsics: Four | None = None
    distortion: Four | None = None
    calibrated: bool = False


class CameraSection(_Section):
    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    video: str
    intrinsics: Four | None = None
    distortion: Four | None = None
    calibrated: bool = False
    T_world_cam: list[Four] | None = Field(default=None, min_length=4, max_length=4)


class DemoSection(_Section):
    joints: str
    clock_offset_s: FiniteFloat | None = None
    cameras: list[CameraSection] = Field(min_length=1)


class PromptSection(_Section):
    part: Literal["robot", "moving", "static"]
    image: str
    points: list[Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]] = []
    box: Four | None = None


class CaptureManifest(_Section):
    format: Literal[1]
    name: str = Field(min_length=1)
    category: str = Field(min_length=1)
    instruction: str = Field(min_length=1)
    robot: RobotSection
    scan: ScanSection
    demo: DemoSection
    prompts: list[PromptSection] = []


def read_manifest(path: Path) -> CaptureManifest:
    """Parse and validate one capture.toml.

    Raises:
        MissingFileError, LimitExceededError: No such file, or larger than 1 MiB.
        MalformedFileError: Not TOML, an unknown key (the nearest known one is named), a wrong
            type or a missing key.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "a capture folder holds a capture.toml; see the README")
    if not path.stat().st_size <= MAX_BYTES:
        raise LimitExceededError(path, f"is larger than {MAX_BYTES} bytes")
    try:
        data = tomllib.loads(path.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedFileError(path, f"is not valid TOML ({error})", "correct that line") from error
    try:
        return CaptureManifest.model_validate(data)
    except ValidationError as error:
        raise MalformedFileError(path, *complaint(error, CaptureManifest)) from error
