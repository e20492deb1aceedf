"""Training images: the size they are fitted at, and what is fitted of each: exposure and camera pose."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.splatting import native
from aomgen.splatting.compute import native_adam_step

# A color value from which on a photograph only says "at least this bright".
SATURATED = 250 / 255


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingView:
    """One image at the size it is fitted at: camera and planar (3, H, W) uint8."""

    camera: Camera
    image: Tensor

    def move(self, device: str) -> "TrainingView":
        """The same view with its pixels on a device."""
        return TrainingView(camera=self.camera, image=self.image.to(device))

    def target(self) -> Tensor:
        """(3, H, W) float32, sRGB 0..1."""
        return self.image.float().div_(255)


@dataclass(slots=True, kw_only=True)
class ImageParameters:
    """C numbers of every image that are fitted with the Gaussians, and their optimizer state.

    Attributes:
        enabled: False leaves them as they are.
        values: (M, C) float32.
        averages, squares: Moments of their gradients (M, C).
        steps: (M,) int64 optimizer steps.
    """

    enabled: bool
    values: Tensor
    averages: Tensor
    squares: Tensor
    steps: Tensor

    def tensors(self) -> dict[str, Tensor]:
        """Tensors to store, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "enabled"}

    def leaf(self, index: int) -> Tensor | None:
        """The numbers (C,) of an image, to collect a gradient; None when they are not fitted."""
        return self.values[index].clone().requires_grad_() if self.enabled else None

    def adam_step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """One step of one image's numbers."""
        self.steps[index] += 1
        row = slice(index, index + 1)
        moments, rates = (self.averages[row], self.squares[row]), torch.full(gradient.shape, rate)
        native_adam_step(context, self.values[row], gradient[None], moments, rates, int(self.steps[index]))


def _zeros(count: int, columns: int) -> dict[str, Tensor]:
    moments = {name: torch.zeros(count, columns) for name in ("values", "averages", "squares")}
    return moments | {"steps": torch.zeros(count, dtype=torch.int64)}


@dataclass(slots=True, kw_only=True)
class Exposure(ImageParameters):
    """Logarithms of the gains of every image's colors, C = 3."""

    @staticmethod
    def neutral(count: int, enabled: bool) -> "Exposure":
        """Gains of one."""
        return Exposure(enabled=enabled, **_zeros(count, 3))

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Adam on one image's gains; afterwards the mean over the images is zero again."""
        self.adam_step(index, gradient, rate, context)
        self.values -= self.values.mean(0)


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
    # Cropping at the border shifts nothing, so `Camera.resize` would be wrong.
    optics = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return TrainingView(camera=replace(camera, width=width, height=height, **optics), image=pooled)


@dataclass(slots=True, kw_only=True)
class PoseIncrements(ImageParameters):
    """A rigid motion (twist) before every camera: T_cam_world = T_given exp(twist), with optimizer state.

    Twists are taken about the middle of the scene and translations measured in its extent, so
    that all six numbers move an image about as far.

    C = 6: rotation [rad], translation [extents], world axes.

    Attributes:
        gauge: (6 M, 7) float32, orthonormal: motions of all cameras at once that change no image,
            because the scene could move along (rotation, translation, scale).
        to_middle: (4, 4) float32, from the world to middle and extent.
    """

    gauge: Tensor
    to_middle: Tensor

    @staticmethod
    def neutral(cameras: list[Camera], middle: Array, extent: float, enabled: bool) -> "PoseIncrements":
        """No corrections yet, for a scene with this middle (3,) and extent."""
        to_middle = np.eye(4)
        to_middle[:3] = np.column_stack([np.eye(3), -middle]) / extent
        centers = (np.array([camera.center for camera in cameras]) - middle) / extent
        return PoseIncrements(
            enabled=enabled,
            **_zeros(len(cameras), 6),
            gauge=torch.tensor(gauge_motions(centers), dtype=torch.float32),
            to_middle=torch.tensor(to_middle, dtype=torch.float32),
        )

    def T_cam_world(self, camera: Camera, twist: Tensor) -> Tensor:
        """The camera's pose (4, 4) after a twist (6,), differentiable by it."""
        T_given = torch.tensor(camera.T_cam_world, dtype=torch.float32)
        x, y, z = twist[:3].unbind()
        zero = torch.zeros(())
        rows = [
            torch.stack([zero, -z, y, twist[3]]),
            torch.stack([z, zero, -x, twist[4]]),
            torch.stack([-y, x, zero, twist[5]]),
            torch.zeros(4),
        ]
        motion = torch.linalg.matrix_exp(torch.stack(rows))
        return T_given @ torch.linalg.solve(self.to_middle, motion @ self.to_middle)

    def correct(self, index: int, camera: Camera) -> Camera:
        """The camera of an image (at any resolution) with its correction."""
        if not self.enabled:
            return camera
        T_cam_world = self.T_cam_world(camera, self.values[index]).double().numpy()
        return camera.move(np.linalg.inv(T_cam_world))

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Adam on one image's twist; afterwards all twists together hold no gauge motion."""
        self.adam_step(index, gradient, rate, context)
        flat = self.values.view(-1)
        flat -= self.gauge @ (self.gauge.T @ flat)


def gauge_motions(centers: Array) -> Array:
    """Orthonormal (6 M, 7): twists of M cameras that a similarity of the whole scene explains.

    Centers (M, 3) are relative to the point that twists are taken about.
    """
    count = len(centers)
    motions = np.zeros((count, 6, 7))
    motions[:, :, :6] = np.eye(6)
    # A camera at c goes to c - rotation x c - translation: growing about the middle is c itself.
    motions[:, 3:, 6] = centers
    return np.linalg.qr(motions.reshape(6 * count, 7))[0]
