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
        radiance_linear: (H, W, 3). Rows go from straight up (+z) to straight down; the center is +x, and
            columns continue from there to -y, as seen when looking along +x.
    """

    radiance_linear: Annotated[NDArray[np.float32], "H W 3"]

    __post_init__ = freeze_arrays

    @property
    def directions(self) -> Array:
        """Unit directions (H, W, 3) from which the pixels' light comes."""
        return map_directions(*self.radiance_linear.shape[:2])

    @property
    def solid_angles(self) -> Array:
        """Solid angle (H,) of a pixel of each row, [sr]; 4 pi over all pixels."""
        height, width = self.radiance_linear.shape[:2]
        borders = np.cos(np.linspace(0, np.pi, height + 1))
        return np.asarray((borders[:-1] - borders[1:]) * (2 * np.pi / width), np.float64)

    def light(self) -> Light:
        """Compute the light of the first nine harmonics."""
        height, width = self.radiance_linear.shape[:2]
        longitudes, sh = _longitudes(width), np.zeros((9, 3))
        # Row by row: the basis of a whole image would take gigabytes.
        for row, polar, solid_angle in zip(
            self.radiance_linear, _polar_angles(height), self.solid_angles, strict=True
        ):
            sh += project_radiance(_unit(polar, longitudes), solid_angle, row)
        return light_from_harmonics(sh)

    def turn(self, angle_rad: float) -> "EnvironmentMap":
        """Rotate about the vertical, counterclockwise as seen from above; linear between columns."""
        shift = angle_rad * self.radiance_linear.shape[1] / (2 * np.pi)
        whole = int(np.floor(shift))
        near, far = (np.roll(self.radiance_linear, -step, axis=1) for step in (whole, whole + 1))
        mixed = near + (shift - whole) * (far - near)
        return EnvironmentMap(radiance_linear=mixed.astype(np.float32))


def map_directions(height: int, width: int) -> Array:
    """Compute unit directions (H, W, 3), world frame, of the pixels of an `EnvironmentMap`."""
    return _unit(_polar_angles(height)[:, None], _longitudes(width))


def _polar_angles(height: int) -> Array:
    """Compute the angle (H,) of each row from straight up, [rad]."""
    return np.asarray((np.arange(height) + 0.5) * (np.pi / height), np.float64)


def _longitudes(width: int) -> Array:
    """Compute the angle (W,) of each column from +x towards +y, [rad]."""
    return np.asarray(np.pi - (np.arange(width) + 0.5) * (2 * np.pi / width), np.float64)


def _unit(polar: ArrayLike, longitudes: Array) -> Array:
    sines, heights, longitudes = np.broadcast_arrays(np.sin(polar), np.cos(polar), longitudes)
    return np.stack([sines * np.cos(longitudes), sines * np.sin(longitudes), heights], -1)
