"""Small corrections of the training cameras' poses, fitted with the Gaussians."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.splatting import native


@dataclass(slots=True, kw_only=True)
class PoseIncrements:
    """A rigid motion (twist) before every camera: T_cam_world = T_given exp(twist), with optimizer state.

    Twists are taken about the middle of the scene and translations measured in its extent, so
    that all six numbers move an image about as far.

    Attributes:
        enabled: False leaves the cameras as they are.
        twists: (M, 6) float32: rotation [rad], translation [extents], world axes.
        averages, squares: Moments of their gradients.
        steps: (M,) int64 optimizer steps.
        gauge: (6 M, 7) float32, orthonormal: motions of all cameras at once that change no image,
            because the scene could move along (rotation, translation, scale).
        to_middle: (4, 4) float32, from the world to middle and extent.
    """

    enabled: bool
    twists: Tensor
    averages: Tensor
    squares: Tensor
    steps: Tensor
    gauge: Tensor
    to_middle: Tensor

    @staticmethod
    def neutral(cameras: list[Camera], middle: Array, extent: float, enabled: bool) -> "PoseIncrements":
        """No corrections yet, for a scene with this middle (3,) and extent."""
        to_middle = np.eye(4)
        to_middle[:3] = np.column_stack([np.eye(3), -middle]) / extent
        centers = (np.array([camera.center for camera in cameras]) - middle) / extent
        zeros = [torch.zeros(len(cameras), 6) for _ in range(3)]
        return PoseIncrements(
            enabled=enabled,
            twists=zeros[0],
            averages=zeros[1],
            squares=zeros[2],
            steps=torch.zeros(len(cameras), dtype=torch.int64),
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

    def corrected(self, index: int, camera: Camera) -> Camera:
        """The camera of an image (at any resolution) with its correction."""
        if not self.enabled:
            return camera
        T_cam_world = self.T_cam_world(camera, self.twists[index]).double().numpy()
        return camera.moved(np.linalg.inv(T_cam_world))

    def step(self, index: int, gradient: Tensor, rate: float, context: native.Context) -> None:
        """Adam on one image's twist; afterwards all twists together hold no gauge motion."""
        self.steps[index] += 1
        rates, gradient = torch.full((6,), rate), gradient.contiguous()
        addresses = (
            self.twists[index].data_ptr(),
            gradient.data_ptr(),
            self.averages[index].data_ptr(),
            self.squares[index].data_ptr(),
            rates.data_ptr(),
        )
        context.adam_step((1, 6), addresses, int(self.steps[index]))
        flat = self.twists.view(-1)
        flat -= self.gauge @ (self.gauge.T @ flat)


def gauge_motions(centers: Array) -> Array:
    """Orthonormal (6 M, 7): twists of M cameras that a similarity of the whole scene explains.

    Args:
        centers: Of the cameras (M, 3), relative to the point that twists are taken about.
    """
    count = len(centers)
    motions = np.zeros((count, 6, 7))
    motions[:, :, :6] = np.eye(6)
    # A camera at c goes to c - rotation x c - translation: growing about the middle is c itself.
    motions[:, 3:, 6] = centers
    return np.linalg.qr(motions.reshape(6 * count, 7))[0]
