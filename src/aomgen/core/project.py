"""Settings of a run, as written in its project file."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

# Values of a project's `light` that are not the path of an HDRI: the light of the scan, and the prefix of a network's folder.
SCAN_LIGHT, DIFFUSION_LIGHT = "scan", "diffusion:"
# Sides of images are even, because videos store colors at half the resolution.
Side = Annotated[int, Field(ge=64, le=4096, multiple_of=2)]


class Project(BaseModel):
    """Settings of one run; paths are absolute after loading.

    Attributes:
        capture: Folder of the capture.
        out: Folder of the results.
        seed: Seed of all random numbers from the twin stage on.
        assets: Assets that replace the object: `category:seed`, a USD path, or "original" for the recorded object itself.
        poses: Requested number of verified episodes for each asset.
        adapt: Method that fits asset and motion to each other; see `replacement.fitting`.
        light: Light on new objects: "scan", the light estimated from the scene; the path of an HDRI; or
            "diffusion:FOLDER", see `replacement.diffusion`.
        light_yaw_deg: Rotation of an HDRI about the vertical, counterclockwise as seen from above.
        inpainter: Folder of a diffusion pipeline that inpaints unobserved regions of the table, see
            `replacement.diffusion`; empty for texture synthesis from observed regions.
        image_size: Width and height of the episodes' images, [px].
        iterations: Number of training steps of the scene's Gaussians.
        gaussians: Largest number of Gaussians in the scene.
        segmenter: Source of the masks; see `segmentation.segmenter`.
        alignment_method: Method that aligns scan and robot; "paper" is the baseline.
        motion_method: Method that estimates the part's motion; "paper" is the baseline.
        parts_method: Method that labels the object's parts; see `parts.label`.
        params: Parameters of stages that differ from the defaults, by stage, nested like the stage's dataclasses.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    capture: Path
    out: Path
    seed: int = Field(default=0, ge=0)
    assets: tuple[str, ...] = Field(default=(), min_length=0)
    poses: int = Field(default=6, ge=1, le=10_000)
    adapt: Literal["trajectory", "object", "auto"] = "trajectory"
    light: str = Field(default=SCAN_LIGHT, min_length=1)
    light_yaw_deg: float = Field(default=0.0, ge=-360, le=360)
    inpainter: str = ""
    image_size: tuple[Side, Side] = (320, 240)
    iterations: int = Field(default=1050, ge=10, le=200_000)
    gaussians: int = Field(default=100_000, ge=1_000, le=3_000_000)
    segmenter: str = Field(default="auto", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    alignment_method: Literal["outlines", "paper"] = "outlines"
    motion_method: Literal["aomotion", "paper"] = "aomotion"
    parts_method: Literal["closed_form", "saga"] = "closed_form"
    params: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @property
    def networks(self) -> tuple[Path, ...]:
        """Folders of the diffusion pipelines that a run uses."""
        head, path = split_light(self.light)
        return tuple(Path(name) for name in (path * (head == DIFFUSION_LIGHT), self.inpainter) if name)


def split_light(light: str) -> tuple[str, str]:
    """Split a project's `light` into a kind (`SCAN_LIGHT`, `DIFFUSION_LIGHT` or "") and a path, which may be empty."""
    if light == SCAN_LIGHT:
        return SCAN_LIGHT, ""
    head = DIFFUSION_LIGHT if light.startswith(DIFFUSION_LIGHT) else ""
    return head, light.removeprefix(head)
