"""Parametric handles that a parallel gripper can hold from the front: bars, arches, straps, knobs, lips, cups."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.procedural.shapes import (
    ALL_EDGES,
    AlignedBox,
    Material,
    RoundedBox,
    box,
    boxes_mesh,
    merge_meshes,
    rod,
)
from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import transform
from aomgen.core.values import Array

# Outward normal of all fronts, asset frame.
OUTWARD: Final = np.array([0.0, -1.0, 0.0])
# Thickness of the posts of a bar and their distance from its ends, as multiples of the bar's thickness.
POST: Final = 0.8
# Share of an arch's length that is bent at each end, and the number of pieces that approximate the bend.
BENT_SHARE, BENT_PIECES = 0.27, 4
# Ratio of a strap's depth to its width.
STRAP: Final = 0.5
# Distance of the grasp point from the outer edge of a solid handle, and height of the cheeks of a cup handle, [m].
HELD, CHEEK = 0.016, 0.026
# Ratio of the radius of a knob's edges to its thickness.
KNOB_EDGE: Final = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Handle(ABC):
    """A graspable shape that protrudes from a front; lengths in [m], asset frame.

    Attributes:
        foot: Point on the plane of the front behind the handle's center (3,).
        axis: Unit direction of the handle (3,), horizontal or vertical.
        length: Extent along the axis.
        thickness: Extent across the axis, in the plane of the front.
        clearance: Clearance between front and bar, or protrusion of a solid handle.
    """

    foot: Array
    axis: Array
    length: float
    thickness: float
    clearance: float

    @property
    def middle(self) -> Array:
        """The grasp point (3,), [m]."""
        return self.foot + OUTWARD * (self.clearance - HELD)

    @abstractmethod
    def boxes(self) -> dict[str, AlignedBox]:
        """Return the colliders by name; all names start with "handle"."""

    def mesh(self, surface: Material) -> Mesh:
        """Build the visible mesh."""
        return boxes_mesh("handle", list(self.boxes().values()), surface)

    def colliders(self, prefix: str = "") -> list[BoxCollider]:
        """Return all colliders; a prefix marks those of a handle that is not the held one."""
        return [row.collider(prefix + name) for name, row in self.boxes().items()]

    def point(self, along: float, out: float) -> Array:
        """Compute the point (3,) at given distances from the foot along the handle and out of the front, [m]."""
        return self.foot + along * self.axis + out * OUTWARD

    def block(self, along: ArrayLike, out: ArrayLike, across: ArrayLike) -> AlignedBox:
        """Build a box from pairs of coordinates (2,) along the handle, out of the front and across the handle.

        The coordinates are relative to the foot, [m].
        """
        spans = (along, across) if self.axis[0] > 0.5 else (across, along)
        (x0, x1), (z0, z1) = (np.asarray(span) + self.foot[i] for span, i in zip(spans, (0, 2), strict=True))
        y1, y0 = self.foot[1] - np.asarray(out)
        return box(x0, x1, y0, y1, z0, z1)


class BarHandle(Handle):
    """A round bar on two posts."""

    @property
    def middle(self) -> Array:
        """The center of the bar (3,), [m]."""
        return self.point(0.0, self.clearance + self.thickness / 2)

    def mesh(self, surface: Material) -> Mesh:
        """Build the round bar and its posts."""
        half, radius = self.axis * self.length / 2, self.thickness / 2
        rods = [rod("bar", self.middle - half, self.middle + half, radius, surface)]
        for offset in self._post_offsets():
            post = self.point(offset, 0.0), self.middle + offset * self.axis
            rods.append(rod("post", *post, POST * radius, surface, 10))
        return merge_meshes("handle", rods)

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the colliders of the bar and its posts."""
        half, round_ = self.length / 2, np.array([-0.5, 0.5]) * self.thickness
        out = (self.clearance, self.clearance + self.thickness)
        rows = {"handle_bar": self.block((-half, half), out, round_)}
        for name, offset in zip(("low", "high"), self._post_offsets(), strict=True):
            rows[f"handle_post_{name}"] = self.block(
                offset + POST * round_, (0, self.clearance), POST * round_
            )
        return rows

    def _post_offsets(self) -> tuple[float, float]:
        offset = self.length / 2 - POST * self.thickness
        return -offset, offset


class ArchHandle(BarHandle):
    """A round bar whose ends are bent toward the front."""

    def mesh(self, surface: Material) -> Mesh:
        """Build the arch from short rods, each slightly longer than its piece, so that there are no gaps at the joints."""
        rods = []
        for start, end in self._pieces():
            more = 0.2 * self.thickness / 2 * (end - start) / np.linalg.norm(end - start)
            rods.append(rod("piece", start - more, end + more, self.thickness / 2, surface))
        return merge_meshes("handle", rods)

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the collider of the straight part."""
        half, round_ = (0.5 - BENT_SHARE) * self.length, np.array([-0.5, 0.5]) * self.thickness
        out = (self.clearance, self.clearance + self.thickness)
        return {"handle_bar": self.block((-half, half), out, round_)}

    def colliders(self, prefix: str = "") -> list[BoxCollider]:
        """Return the colliders of the straight part and of every piece of the bent ends."""
        bent = [
            _cover_rod(f"{prefix}handle_bend_{i}", start, end, self.thickness / 2)
            for i, (start, end) in enumerate(self._pieces()[1:])
        ]
        return [*Handle.colliders(self, prefix), *bent]

    def _pieces(self) -> list[tuple[Array, Array]]:
        """Return the end points of the straight part, followed by those of the pieces on both sides."""
        straight, bent = (0.5 - BENT_SHARE) * self.length, BENT_SHARE * self.length
        turns = np.linspace(0.0, np.pi / 2, BENT_PIECES + 1)
        height = self.clearance + self.thickness / 2
        found = [(self.point(-straight, height), self.point(straight, height))]
        for side in (-1.0, 1.0):
            points = [self.point(side * (straight + bent * np.sin(t)), height * np.cos(t)) for t in turns]
            found += pairwise(points)
        return found


class StrapHandle(Handle):
    """A flat strap with both ends bent at right angles toward the front."""

    @property
    def middle(self) -> Array:
        """The center of the strap (3,), [m]."""
        return self.point(0.0, self.clearance + STRAP * self.thickness / 2)

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the colliders of the strap and its ends."""
        half, flat, sides = self.length / 2, STRAP * self.thickness, np.array([-0.5, 0.5]) * self.thickness
        out = (0, self.clearance)
        return {
            "handle_bar": self.block((-half, half), (self.clearance, self.clearance + flat), sides),
            "handle_post_low": self.block((-half, -half + flat), out, sides),
            "handle_post_high": self.block((half - flat, half), out, sides),
        }


class LipHandle(Handle):
    """A plate that protrudes from the front."""

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the collider of the plate."""
        half, sides = self.length / 2, np.array([-0.5, 0.5]) * self.thickness
        return {"handle_bar": self.block((-half, half), (0, self.clearance), sides)}


class CupHandle(LipHandle):
    """A plate with a vertical cheek below each end."""

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the colliders of the plate and its cheeks."""
        half, thick, low = self.length / 2, self.thickness, -self.thickness / 2
        out, across = (0, self.clearance), (low - CHEEK, low)
        return {
            **LipHandle.boxes(self),
            "handle_cheek_low": self.block((-half, -half + thick), out, across),
            "handle_cheek_high": self.block((half - thick, half), out, across),
        }


class KnobHandle(Handle):
    """A square knob with rounded edges, whose length is its thickness.

    It has a single box collider, because a grasp on several colliders slips in simulation.
    """

    def boxes(self) -> dict[str, AlignedBox]:
        """Return the collider, which is the knob without rounding."""
        sides = np.array([-0.5, 0.5]) * self.thickness
        return {"handle_bar": self.block(sides, (0, self.clearance), sides)}

    def mesh(self, surface: Material) -> Mesh:
        """Build the knob with rounded edges."""
        radius = KNOB_EDGE * self.thickness
        whole = self.boxes()["handle_bar"]
        knob = RoundedBox(whole=whole, axis=1, radii=(radius, radius), corners=ALL_EDGES)
        return knob.mesh("handle", surface)


# Handle classes by their names in `designs.toml`.
HANDLES: Final[dict[str, type[Handle]]] = {
    "bar": BarHandle,
    "arch": ArchHandle,
    "strap": StrapHandle,
    "knob": KnobHandle,
    "lip": LipHandle,
    "cup": CupHandle,
}


def make_handle(s: SimpleNamespace, foot: ArrayLike, axis: Array, length: float) -> Handle:
    """Make a handle with the kind, thickness and clearance of the sampled sizes.

    Args:
        s: Sampled sizes with `handle`, `bar_thickness` and `bar_clearance`.
        foot: Point on the plane of the front behind the handle's center (3,), [m].
        axis: Unit direction (3,).
        length: Extent along the axis, [m].
    """
    place = np.asarray(foot, np.float64)
    return HANDLES[s.handle](
        foot=place, axis=axis, length=length, thickness=s.bar_thickness, clearance=s.bar_clearance
    )


def _cover_rod(name: str, start: Array, end: Array, radius: float) -> BoxCollider:
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, OUTWARD)
    side /= np.linalg.norm(side)
    R = np.stack([along, side, np.cross(along, side)], 1)
    half = np.array([np.linalg.norm(end - start) / 2, radius, radius])
    return BoxCollider(name=name, T_asset_box=transform(R, (start + end) / 2), half_extents=half)
