"""Every choice of a run."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

# Videos halve the resolution of colors, so their sides are even.
Side = Annotated[int, Field(ge=64, le=4096, multiple_of=2)]


class Project(BaseModel):
    """Choices of one run; paths are absolute after loading.

    Attributes:
        capture: Folder of the capture.
        out: Folder of the results.
        seed: Seed of everything random from the twin onwards.
        assets: Assets that replace the object, `category:seed`, a USD path, or "original" for the recorded object itself.
        poses: Verified episodes wanted for each asset.
        adapt: How asset and motion are brought together; see `replacement.fitting`.
        image_size: Size of the episodes' images, [px].
        iterations: Training steps.
        gaussians: Cap on the number of Gaussians in the scene.
        segmenter: What makes masks; see `segmentation.segmenter`.
        alignment_method: How scan and robot are brought together; "paper" is there to compare with.
        motion_method: How the part's motion is recovered; "paper" is there to compare with.
        parts_method: How the object's parts are found; see `parts.label`.
        params: Parameters of stages that are not at their defaults, by stage, nested as its dataclasses are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    capture: Path
    out: Path
    seed: int = Field(default=0, ge=0)
    assets: tuple[str, ...] = Field(default=(), min_length=0)
    poses: int = Field(default=6, ge=1, le=10_000)
    adapt: Literal["trajectory", "object", "auto"] = "trajectory"
    image_size: tuple[Side, Side] = (320, 240)
    iterations: int = Field(default=1200, ge=10, le=200_000)
    gaussians: int = Field(default=100_000, ge=1_000, le=3_000_000)
    segmenter: str = Field(default="auto", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    alignment_method: Literal["outlines", "paper"] = "outlines"
    motion_method: Literal["aomotion", "paper"] = "aomotion"
    parts_method: Literal["closed_form", "saga"] = "closed_form"
    params: dict[str, dict[str, Any]] = Field(default_factory=dict)
