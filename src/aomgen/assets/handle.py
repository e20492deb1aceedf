"""Bar handles: a bar on two posts that a parallel gripper can hold from the front."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets.shapes import Material, merge_meshes, rod
from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import transform
from aomgen.core.values import Array

# Canonical assets have their front towards -y.
OUTWARD = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class BarHandle:
    """Geometry of one handle on a front that faces -y.

    Attributes:
        foot: Point of the front's plane behind the bar's middle (3,), [m].
        axis: Unit direction of the bar (3,).
        length: Length of the bar, [m].
        thickness: Diameter of the bar, [m].
        clearance: Free depth between front and bar, [m].
    """

    foot: Array
    axis: Array
    length: float
    thickness: float
    clearance: float

    @property
    def middle(self) -> Array:
        """Middle of the bar (3,), [m]."""
        return self.foot + OUTWARD * (self.clearance + self.thickness / 2)

    def mesh(self, surface: Material) -> Mesh:
        """Round bar and posts."""
        half = self.axis * self.length / 2
        radius = self.thickness / 2
        rods = [rod("bar", self.middle - half, self.middle + half, radius, surface)]
        for side in (-1.0, 1.0):
            offset = side * self._post_offset()
            rods.append(rod("post", self.foot + offset, self.middle + offset, 0.8 * radius, surface, 10))
        return merge_meshes("handle", rods)

    def colliders(self, prefix: str = "") -> tuple[BoxCollider, ...]:
        """Boxes of bar and posts; all names start with "handle", after a prefix for what does not move."""
        radius = self.thickness / 2
        along = np.abs(self.axis)
        bar = np.where(along > 0.5, self.length / 2, radius)
        boxes = [_collider(f"{prefix}handle_bar", self.middle, bar)]
        for name, side in (("handle_post_low", -1.0), ("handle_post_high", 1.0)):
            centre = self.foot + OUTWARD * self.clearance / 2 + side * self._post_offset()
            boxes.append(
                _collider(prefix + name, centre, np.array([0.8 * radius, self.clearance / 2, 0.8 * radius]))
            )
        return tuple(boxes)

    def _post_offset(self) -> Array:
        return self.axis * (self.length / 2 - 0.8 * self.thickness)


def _collider(name: str, centre: Array, half_extents: Array) -> BoxCollider:
    return BoxCollider(name=name, T_asset_box=transform(np.eye(3), centre), half_extents=half_extents)
