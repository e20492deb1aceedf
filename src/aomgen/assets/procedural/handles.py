"""Handles that a parallel gripper can hold from the front: bars, arches, straps, knobs, lips, cups."""

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

# Outward normal of fronts.
OUTWARD: Final = np.array([0.0, -1.0, 0.0])
# Posts of a bar: their thickness, and their distance from its ends, in thicknesses of the bar.
POST: Final = 0.8
# Share of an arch's length that is bent at either end, and the number of its pieces.
BENT_SHARE, BENT_PIECES = 0.27, 4
# Depth of a strap over its width.
STRAP: Final = 0.5
# Distance of the held point from a solid handle's outer edge, and height of the cheeks of a cup, [m].
HELD, CHEEK = 0.016, 0.026
# Radius of a knob's edges over its thickness.
KNOB_EDGE: Final = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Handle(ABC):
    """A graspable shape that protrudes from a front, [m].

    Attributes:
        foot: Point of the front's plane behind the handle's middle (3,).
        axis: Unit direction of the handle: level or upright (3,).
        length: Extent along the axis.
        thickness: Extent across the axis.
        clearance: Free depth between front and bar, or protrusion of a solid handle.
    """

    foot: Array
    axis: Array
    length: float
    thickness: float
    clearance: float

    @property
    def middle(self) -> Array:
        """Grasp point (3,), [m]."""
        return self.foot + OUTWARD * (self.clearance - HELD)

    @abstractmethod
    def boxes(self) -> dict[str, AlignedBox]:
        """Colliders by name; all names start with "handle"."""

    def mesh(self, surface: Material) -> Mesh:
        """Visible mesh."""
        return boxes_mesh("handle", list(self.boxes().values()), surface)

    def colliders(self, prefix: str = "") -> list[BoxCollider]:
        """Colliders; with a prefix on a static link."""
        return [row.collider(prefix + name) for name, row in self.boxes().items()]

    def point(self, along: float, out: float) -> Array:
        """Point (3,) at distances from the foot along the handle and out of the front."""
        return self.foot + along * self.axis + out * OUTWARD

    def block(self, along: ArrayLike, out: ArrayLike, across: ArrayLike) -> AlignedBox:
        """A box between planes (2,) along the handle, out of the front and across the handle, from the foot."""
        spans = (along, across) if self.axis[0] > 0.5 else (across, along)
        (x0, x1), (z0, z1) = (np.asarray(span) + self.foot[i] for span, i in zip(spans, (0, 2), strict=True))
        y1, y0 = self.foot[1] - np.asarray(out)
        return box(x0, x1, y0, y1, z0, z1)


class BarHandle(Handle):
    """A round bar on two posts."""

    @property
    def middle(self) -> Array:
        """Middle of the bar (3,), [m]."""
        return self.point(0.0, self.clearance + self.thickness / 2)

    def mesh(self, surface: Material) -> Mesh:
        """Round bar and posts."""
        half, radius = self.axis * self.length / 2, self.thickness / 2
        rods = [rod("bar", self.middle - half, self.middle + half, radius, surface)]
        for offset in self._post_offsets():
            post = self.point(offset, 0.0), self.middle + offset * self.axis
            rods.append(rod("post", *post, POST * radius, surface, 10))
        return merge_meshes("handle", rods)

    def boxes(self) -> dict[str, AlignedBox]:
        """Colliders of bar and posts."""
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
    """A round bar whose ends bend to the front."""

    def mesh(self, surface: Material) -> Mesh:
        """Short rods, each a little longer than its piece of the arch, so that none gapes."""
        rods = []
        for start, end in self._pieces():
            more = 0.2 * self.thickness / 2 * (end - start) / np.linalg.norm(end - start)
            rods.append(rod("piece", start - more, end + more, self.thickness / 2, surface))
        return merge_meshes("handle", rods)

    def boxes(self) -> dict[str, AlignedBox]:
        """Collider of the straight part."""
        half, round_ = (0.5 - BENT_SHARE) * self.length, np.array([-0.5, 0.5]) * self.thickness
        out = (self.clearance, self.clearance + self.thickness)
        return {"handle_bar": self.block((-half, half), out, round_)}

    def colliders(self, prefix: str = "") -> list[BoxCollider]:
        """Colliders of the straight part and of every piece of the ends."""
        bent = [
            _cover_rod(f"{prefix}handle_bend_{i}", start, end, self.thickness / 2)
            for i, (start, end) in enumerate(self._pieces()[1:])
        ]
        return [*Handle.colliders(self, prefix), *bent]

    def _pieces(self) -> list[tuple[Array, Array]]:
        """Ends of the straight part, then of the pieces on either side."""
        straight, bent = (0.5 - BENT_SHARE) * self.length, BENT_SHARE * self.length
        turns = np.linspace(0.0, np.pi / 2, BENT_PIECES + 1)
        height = self.clearance + self.thickness / 2
        found = [(self.point(-straight, height), self.point(straight, height))]
        for side in (-1.0, 1.0):
            points = [self.point(side * (straight + bent * np.sin(t)), height * np.cos(t)) for t in turns]
            found += pairwise(points)
        return found


class StrapHandle(Handle):
    """A flat strap, bent square to the front at both ends."""

    @property
    def middle(self) -> Array:
        """Middle of the strap (3,), [m]."""
        return self.point(0.0, self.clearance + STRAP * self.thickness / 2)

    def boxes(self) -> dict[str, AlignedBox]:
        """Strap and ends."""
        half, flat, sides = self.length / 2, STRAP * self.thickness, np.array([-0.5, 0.5]) * self.thickness
        out = (0, self.clearance)
        return {
            "handle_bar": self.block((-half, half), (self.clearance, self.clearance + flat), sides),
            "handle_post_low": self.block((-half, -half + flat), out, sides),
            "handle_post_high": self.block((half - flat, half), out, sides),
        }


class LipHandle(Handle):
    """A plate that protrudes like a rim."""

    def boxes(self) -> dict[str, AlignedBox]:
        """The plate."""
        half, sides = self.length / 2, np.array([-0.5, 0.5]) * self.thickness
        return {"handle_bar": self.block((-half, half), (0, self.clearance), sides)}


class CupHandle(LipHandle):
    """A plate with a cheek below each end."""

    def boxes(self) -> dict[str, AlignedBox]:
        """Plate and cheeks."""
        half, thick, low = self.length / 2, self.thickness, -self.thickness / 2
        out, across = (0, self.clearance), (low - CHEEK, low)
        return {
            **LipHandle.boxes(self),
            "handle_cheek_low": self.block((-half, -half + thick), out, across),
            "handle_cheek_high": self.block((half - thick, half), out, across),
        }


class KnobHandle(Handle):
    """A square knob with round edges, as long as it is thick; its one flat collider does not slip as several do."""

    def boxes(self) -> dict[str, AlignedBox]:
        """The knob before its edges are rounded."""
        sides = np.array([-0.5, 0.5]) * self.thickness
        return {"handle_bar": self.block(sides, (0, self.clearance), sides)}

    def mesh(self, surface: Material) -> Mesh:
        """With round edges."""
        radius = KNOB_EDGE * self.thickness
        whole = self.boxes()["handle_bar"]
        knob = RoundedBox(whole=whole, axis=1, radii=(radius, radius), corners=ALL_EDGES)
        return knob.mesh("handle", surface)


# By their name in `designs.toml`.
HANDLES: Final[dict[str, type[Handle]]] = {
    "bar": BarHandle,
    "arch": ArchHandle,
    "strap": StrapHandle,
    "knob": KnobHandle,
    "lip": LipHandle,
    "cup": CupHandle,
}


def make_handle(s: SimpleNamespace, foot: ArrayLike, axis: Array, length: float) -> Handle:
    """Make a handle of the kind, thickness and clearance of the sampled sizes."""
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
