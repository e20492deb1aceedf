"""Images of a training at reduced size, and the parameters that are optimized for each: exposure and camera pose."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.splatting import native
from aomgen.splatting.compute import native_adam_step

# Color values of at least this count as saturated: the scene may be brighter than the photo shows.
SATURATED = 250 / 255


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingView:
    """A training image at the current resolution: camera, and planar image (3, H, W) uint8."""

    camera: Camera
    image: Tensor

    def move(self, device: str) -> "TrainingView":
        """Copy the view to a device."""
        return TrainingView(camera=self.camera, image=self.image.to(device))

    def target(self) -> Tensor:
        """Convert the image to float32 (3, H, W), sRGB 0..1."""
        return self.image.float().div_(255)


@dataclass(slots=True, kw_only=True)
class ImageParameters:
    """C parameters of each of M images that are optimized together with the Gaussians, and their optimizer state.

    Attributes:
        enabled: Whether the parameters are optimized.
        values: Parameters (M, C) float32.
        averages, squares: First and second moments of their gradients (M, C).
        steps: Number of optimizer steps of each image (M,) int64.
    """

    enabled: bool
    values: Tensor
    averages: Tensor
    squares: Tensor
    steps: Tensor

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint stores, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "enabled"}

    def leaf(self, index: int) -> Tensor | None:
        """Return the parameters (C,) of an image as a leaf that collects a gradient; None if they are not optimized."""
        return self.values[index].clone().requires_grad_() if self.enabled else None

    def adam_step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Perform a step of Adam on the parameters of one image, with a gradient (C,) and a learning rate."""
        self.steps[index] += 1
        row = slice(index, index + 1)
        moments, rates = (self.averages[row], self.squares[row]), torch.full(gradient.shape, rate)
        native_adam_step(context, self.values[row], gradient[None], moments, rates, int(self.steps[index]))


def _zeros(count: int, columns: int) -> dict[str, Tensor]:
    moments = {name: torch.zeros(count, columns) for name in ("values", "averages", "squares")}
    return moments | {"steps": torch.zeros(count, dtype=torch.int64)}


@dataclass(slots=True, kw_only=True)
class Exposure(ImageParameters):
    """Logarithms of the color gains of each image, C = 3."""

    @staticmethod
    def neutral(count: int, enabled: bool) -> "Exposure":
        """Create the parameters of `count` images, with gains of one."""
        return Exposure(enabled=enabled, **_zeros(count, 3))

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Perform a step of Adam on the gains of one image, then subtract the mean over all images from their logarithms."""
        self.adam_step(index, gradient, rate, context)
        self.values -= self.values.mean(0)


def clip_to_sensor(rendered: Tensor, target: Tensor, gains: Tensor | None) -> Tensor:
    """Limit a rendering (3, H, W) to the target (3, H, W) where the target is saturated.

    A scene that saturates the sensor is brighter than its photo. At saturated values of the target, a rendering that exceeds
    the target after multiplication with the gains (3,) is set to the target divided by the gains. It then has no error and no
    gradient, so that gains and colors are not fitted to clipped values. Other values do not change.
    """
    shown = target if gains is None else target / gains[:, None, None]
    return torch.where(target >= SATURATED, torch.minimum(rendered, shown), rendered)


def reduce_image(camera: Camera, image: NDArray[np.uint8], factor: int) -> TrainingView:
    """Reduce an image (H, W, 3) uint8 and its camera by averaging blocks of factor x factor pixels.

    Incomplete blocks at the right and bottom are removed. The factor is limited so that each side keeps at least 16 pixels.
    """
    planar = torch.tensor(np.ascontiguousarray(image.transpose(2, 0, 1)))
    factor = max(1, min(factor, image.shape[0] // 16, image.shape[1] // 16))
    if factor == 1:
        return TrainingView(camera=camera, image=planar)
    pooled = torch.nn.functional.avg_pool2d(planar.float(), factor).round_().to(torch.uint8)
    height, width = pooled.shape[1:]
    # The removed border does not change the scale, whereas `Camera.resize` would scale by the ratio of the sizes.
    optics = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return TrainingView(camera=replace(camera, width=width, height=height, **optics), image=pooled)


@dataclass(slots=True, kw_only=True)
class PoseIncrements(ImageParameters):
    """Corrections of the camera poses by twists, T_cam_world = T_given exp(twist), with optimizer state.

    A twist has C = 6 numbers: rotation, [rad], about the center of the scene, and translation in units of the scene's extent,
    both along world axes. In these units all six numbers shift an image by similar amounts.

    Attributes:
        gauge: Orthonormal basis (6 M, 7) float32 of the gauge motions: joint motions of all cameras that a rotation,
            translation or scaling of the scene compensates, so that no image changes.
        to_middle: Transformation (4, 4) float32 from the world frame to a frame at the center, in units of the extent.
    """

    gauge: Tensor
    to_middle: Tensor

    @staticmethod
    def neutral(cameras: list[Camera], middle: Array, extent: float, enabled: bool) -> "PoseIncrements":
        """Create zero corrections for a scene with a center `middle` (3,) and an extent."""
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
        """Compute the pose (4, 4) of a camera after a twist (6,); differentiable with respect to the twist."""
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
        """Apply the correction of an image to its camera, which may have any resolution."""
        if not self.enabled:
            return camera
        T_cam_world = self.T_cam_world(camera, self.values[index]).double().numpy()
        return camera.move(np.linalg.inv(T_cam_world))

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Perform a step of Adam on the twist of one image, then remove gauge motions from all twists."""
        self.adam_step(index, gradient, rate, context)
        flat = self.values.view(-1)
        flat -= self.gauge @ (self.gauge.T @ flat)


def gauge_motions(centers: Array) -> Array:
    """Compute an orthonormal basis (6 M, 7) of the twists of M cameras that equal a similarity of the whole scene.

    `centers` (M, 3) are the camera centers relative to the center of the twists.
    """
    count = len(centers)
    motions = np.zeros((count, 6, 7))
    motions[:, :, :6] = np.eye(6)
    # A twist moves a camera center c by -(rotation x c) - translation, so translations c scale about the center.
    motions[:, 3:, 6] = centers
    return np.linalg.qr(motions.reshape(6 * count, 7))[0]
