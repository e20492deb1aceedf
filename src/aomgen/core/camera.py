"""A pinhole camera with its pose."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.transforms import apply, invert, similarity_parts
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Pinhole camera, OpenCV axes, pixel centers at +0.5.

    Attributes:
        fx, fy, cx, cy: Intrinsics, [px].
        width, height: Image size, [px].
        T_world_cam: Pose (4, 4). "world" is the frame of the rendered scene: before alignment, this is the `recon` frame,
            which is then part of the name of the variable that holds the camera.

    Example:
        >>> pose = ag.look_at(eye=(1, 0, 1), target=(0, 0, 0))
        >>> camera = ag.Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=pose)
        >>> pixels, depths = camera.project(np.zeros((1, 3)))
        >>> pixels.round(3).tolist(), depths.round(3).tolist()
        ([[160.0, 120.0]], [1.414])
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    T_world_cam: Matrix4

    __post_init__ = freeze_arrays

    @property
    def T_cam_world(self) -> Array:
        """Inverse pose (4, 4)."""
        return invert(self.T_world_cam)

    @property
    def K(self) -> Array:
        """Intrinsic matrix (3, 3), [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def center(self) -> Array:
        """Camera center (3,), world frame."""
        return self.T_world_cam[:3, 3]

    def move(self, T_world_cam: ArrayLike) -> "Camera":
        """Return the camera at another pose (4, 4)."""
        return replace(self, T_world_cam=T_world_cam)

    def resize(self, width: int, height: int) -> "Camera":
        """Return the camera with another resolution, [px], and the same field of view."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )

    def crop(self, left: int, top: int, side: int) -> "Camera":
        """Return the camera of a square section of the image with upper left corner (left, top), [px]."""
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=side, height=side)

    def narrow(self, width: int) -> "Camera":
        """Return the camera with the resolution reduced to at most `width` pixels per row."""
        share = min(1.0, width / self.width)
        return self.resize(round(self.width * share), max(1, round(self.height * share)))

    def project(self, points_world: ArrayLike) -> tuple[Array, Array]:
        """Project points (N, 3) to pixels (N, 2) and depths (N,) along the optical axis, <= 0 behind the camera."""
        points_cam = apply(self.T_cam_world, points_world)
        depths = points_cam[..., 2]
        safe = np.where(np.abs(depths) < 1e-9, 1e-9, depths)
        pixels = np.stack(
            [self.fx * points_cam[..., 0] / safe + self.cx, self.fy * points_cam[..., 1] / safe + self.cy], -1
        )
        return pixels, depths

    def projection_slopes(self, points_world: ArrayLike) -> Array:
        """Compute the derivatives (N, 2, 3) of pixels with respect to the positions of points (N, 3), [px/m]."""
        x, y, z = np.moveaxis(apply(self.T_cam_world, points_world), -1, 0)
        zero = np.zeros_like(z)
        along_u = self.fx * np.stack([1 / z, zero, -x / z**2], -1)
        along_v = self.fy * np.stack([zero, 1 / z, -y / z**2], -1)
        return np.stack([along_u, along_v], -2) @ self.T_cam_world[:3, :3]

    def directions(self) -> Array:
        """Compute the viewing rays (height, width, 3) of all pixels, world frame, scaled to depth 1 (not to unit length)."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        rays_cam = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], -1)
        return rays_cam @ self.T_world_cam[:3, :3].T


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPath:
    """A moving camera: intrinsics of `camera`, whose pose is ignored, and poses (T, 4, 4) at T frames."""

    camera: Camera
    Ts_world_cam: Annotated[Array, "T 4 4"]

    __post_init__ = freeze_arrays

    def at(self, frame: int) -> Camera:
        """Return the camera at one frame."""
        return self.camera.move(self.Ts_world_cam[frame])

    def part(self, frames: slice) -> "CameraPath":
        """Select a range of frames."""
        return replace(self, Ts_world_cam=self.Ts_world_cam[frames])


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Return the pose T_world_cam (4, 4) of a camera at `eye` that looks at `target`, OpenCV axes.

    Args:
        eye, target: Points (3,), [m].
        up: Direction (3,) that points upward in the image.

    Raises:
        ConfigError: `eye` and `target` are equal, or `up` is the viewing direction.

    Example:
        >>> ag.look_at(eye=(1, 0, 0), target=(0, 0, 0))[:3, 2].tolist()
        [-1.0, 0.0, 0.0]
    """
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    distance = float(np.linalg.norm(target - eye))
    if not distance > 0:
        raise ConfigError("target", f"is the eye's position {eye.tolist()}", "choose another target")
    forward = (target - eye) / distance
    right = np.cross(forward, np.asarray(up, np.float64))
    length = float(np.linalg.norm(right))
    if not length > 0:
        raise ConfigError("up", "is parallel to the viewing direction", "choose another direction")
    right /= length
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = eye
    return T


def camera_in_world(S_world_recon: Array, camera_recon: Camera) -> Camera:
    """Transform a camera from the recon frame to the world frame by a similarity (4, 4); its pixels do not change."""
    _, R, _ = similarity_parts(S_world_recon)
    T = np.eye(4)
    T[:3, :3] = R @ camera_recon.T_world_cam[:3, :3]
    T[:3, 3] = apply(S_world_recon, camera_recon.center)
    return camera_recon.move(T)
