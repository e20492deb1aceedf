"""Training images: the size they are fitted at and the exposure they were taken with."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.splatting import native

# A color value from which on a photograph only says "at least this bright".
SATURATED = 250 / 255


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingView:
    """One image at the size it is fitted at: camera and planar (3, H, W) uint8."""

    camera: Camera
    image: Tensor

    def moved(self, device: str) -> "TrainingView":
        """The same view with its pixels on a device."""
        return TrainingView(camera=self.camera, image=self.image.to(device))

    def target(self) -> Tensor:
        """(3, H, W) float32, sRGB 0..1."""
        return self.image.float().div_(255)


@dataclass(slots=True, kw_only=True)
class Exposure:
    """Gains of every image (M, 3) in logarithms, with their optimizer state; steps (M,) int64."""

    enabled: bool
    log_gains: Tensor
    averages: Tensor
    squares: Tensor
    steps: Tensor

    @staticmethod
    def neutral(count: int, enabled: bool) -> "Exposure":
        """Gains of one."""
        zeros = [torch.zeros(count, 3) for _ in range(3)]
        return Exposure(
            enabled=enabled,
            log_gains=zeros[0],
            averages=zeros[1],
            squares=zeros[2],
            steps=torch.zeros(count, dtype=torch.int64),
        )

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Adam on one image's gains; afterwards the mean over the images is zero again."""
        self.steps[index] += 1
        rates = torch.full((3,), rate)
        rows = (
            self.log_gains[index],
            gradient.contiguous(),
            self.averages[index],
            self.squares[index],
            rates,
        )
        first, second, third, fourth, fifth = (row.data_ptr() for row in rows)
        context.adam_step((1, 3), (first, second, third, fourth, fifth), int(self.steps[index]))
        self.log_gains -= self.log_gains.mean(0)


def clip_to_sensor(rendered: Tensor, target: Tensor, gains: Tensor | None) -> Tensor:
    """The rendering (3, H, W), but no brighter than a saturated photograph could show.

    A scene that a sensor clips is brighter than its image. Without this, gains would be fitted
    to clipped values, and clipped values to gains. Where the target is saturated, what the gains
    (3,) lift above it equals it and has no gradient; elsewhere nothing changes.
    """
    shown = target if gains is None else target / gains[:, None, None]
    return torch.where(target >= SATURATED, torch.minimum(rendered, shown), rendered)


def reduce_image(camera: Camera, image: NDArray[np.uint8], factor: int) -> TrainingView:
    """A view whose pixels are means of factor x factor pixels; what does not fill a pixel is cut."""
    planar = torch.tensor(np.ascontiguousarray(image.transpose(2, 0, 1)))
    factor = max(1, min(factor, image.shape[0] // 16, image.shape[1] // 16))
    if factor == 1:
        return TrainingView(camera=camera, image=planar)
    pooled = torch.nn.functional.avg_pool2d(planar.float(), factor).round_().to(torch.uint8)
    height, width = pooled.shape[1:]
    small = replace(
        camera,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
        width=int(width),
        height=int(height),
    )
    return TrainingView(camera=small, image=pooled)
