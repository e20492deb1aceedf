"""The schema of `capture.toml`, format 1."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from aomgen.io.schema import read_toml

Two = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
Four = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RobotSection(_Section):
    model: str = ""
    urdf: str = ""
    mjcf: str = ""
    joints: list[str] = Field(min_length=1)
    gripper: str = "gripper"
    gripper_range: Two | None = None
    base_frame: Literal["base_link", "ur_base"] = "base_link"
    scan_state: Literal["first_row"] | list[FiniteFloat] = "first_row"


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
    proposed: bool = False
    confidence: FiniteFloat | None = Field(default=None, ge=0, le=1)


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
        InputError: See `read_toml`.
    """
    return read_toml(path, CaptureManifest, "a capture folder holds a capture.toml; see the README")
