"""Light from all directions as an equirectangular image, such as an HDRI."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.light import Light, light_from_harmonics, project_radiance
from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentMap:
    """Radiance from all directions, seen from inside, world frame.

    Attributes:
        radiance_linear: Linear RGB (H, W, 3). Rows range from +z (up) to -z; the center column is +x, and columns to the
            right of it continue toward -y, as seen from the center in the direction +x.
    """

    radiance_linear: Annotated[NDArray[np.float32], "H W 3"]

    __post_init__ = freeze_arrays

    @property
    def directions(self) -> Array:
        """Unit directions (H, W, 3), world frame, from which the light of each pixel arrives."""
        return map_directions(*self.radiance_linear.shape[:2])

    @property
    def solid_angles(self) -> Array:
        """Solid angle (H,) of one pixel of each row, [sr]; the sum over all pixels is 4 pi."""
        height, width = self.radiance_linear.shape[:2]
        borders = np.cos(np.linspace(0, np.pi, height + 1))
        return np.asarray((borders[:-1] - borders[1:]) * (2 * np.pi / width), np.float64)

    def light(self) -> Light:
        """Compute the light that is represented by the first nine spherical harmonics."""
        height, width = self.radiance_linear.shape[:2]
        longitudes, sh = _longitudes(width), np.zeros((9, 3))
        # Rows are processed one by one, because the basis of a whole image would take gigabytes.
        for row, polar, solid_angle in zip(
            self.radiance_linear, _polar_angles(height), self.solid_angles, strict=True
        ):
            sh += project_radiance(_unit(polar, longitudes), solid_angle, row)
        return light_from_harmonics(sh)

    def turn(self, angle_rad: float) -> "EnvironmentMap":
        """Rotate the map about the vertical, [rad], counterclockwise as seen from above; columns are interpolated linearly."""
        shift = angle_rad * self.radiance_linear.shape[1] / (2 * np.pi)
        whole = int(np.floor(shift))
        near, far = (np.roll(self.radiance_linear, -step, axis=1) for step in (whole, whole + 1))
        mixed = near + (shift - whole) * (far - near)
        return EnvironmentMap(radiance_linear=mixed.astype(np.float32))


def map_directions(height: int, width: int) -> Array:
    """Compute unit directions (H, W, 3), world frame, of the pixels of an `EnvironmentMap`."""
    return _unit(_polar_angles(height)[:, None], _longitudes(width))


def _polar_angles(height: int) -> Array:
    """Compute the polar angle (H,) of each row, measured from +z, [rad]."""
    return np.asarray((np.arange(height) + 0.5) * (np.pi / height), np.float64)


def _longitudes(width: int) -> Array:
    """Compute the longitude (W,) of each column, measured from +x toward +y, [rad]."""
    return np.asarray(np.pi - (np.arange(width) + 0.5) * (2 * np.pi / width), np.float64)


def _unit(polar: ArrayLike, longitudes: Array) -> Array:
    sines, heights, longitudes = np.broadcast_arrays(np.sin(polar), np.cos(polar), longitudes)
    return np.stack([sines * np.cos(longitudes), sines * np.sin(longitudes), heights], -1)
