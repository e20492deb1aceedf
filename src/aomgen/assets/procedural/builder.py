"""What all designs of made assets share: sizes drawn from a table, links built row by row, bars, joints.

A design is a table of sizes in `designs.toml` and one function that lists boxes, prints and rods in the asset
frame: front towards -y, centred in x, on z = 0.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.procedural.shapes import (
    PRINT_GAP,
    AlignedBox,
    Material,
    box,
    boxes_mesh,
    merge_meshes,
    panel,
    rod,
)
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import transform
from aomgen.core.values import Array

Span = tuple[float, float]
Color = tuple[float, float, float]
Item = TypeVar("Item")
# Where fronts look.
OUTWARD: Final = np.array([0.0, -1.0, 0.0])
LEVEL, _, UPRIGHT = np.eye(3)
# Free depth between body and closed part, [m]: the seal that keeps colliders apart.
SEAL: Final = 0.002
# Directions to the right and up on each face of an object, seen from outside.
FACES: Final = {
    "front": ((1, 0, 0), (0, 0, 1)),
    "top": ((1, 0, 0), (0, 1, 0)),
    "left": ((0, -1, 0), (0, 0, 1)),
    "right": ((0, 1, 0), (0, 0, 1)),
}
# Posts of a bar: their thickness, and their distance from its ends, in thicknesses of the bar.
POST: Final = 0.8


@cache
def design(name: str) -> Mapping[str, Any]:
    """A table of `designs.toml`."""
    return tomllib.loads((Path(__file__).parent / "designs.toml").read_text("utf-8"))[name]


def draw_sizes(rng: np.random.Generator, table: Mapping[str, Span]) -> SimpleNamespace:
    """One number within the range of each row, in the order of the table."""
    return SimpleNamespace(**{name: rng.uniform(*span) for name, span in table.items()})


def pick(rng: np.random.Generator, options: Sequence[Item]) -> Item:
    """One of several, each as likely."""
    return options[int(rng.integers(len(options)))]


def pick_color(rng: np.random.Generator, kind: str) -> Color:
    """One of the usual colors of something, sRGB 0..1."""
    return pick(rng, design("colors")[kind])


@dataclass(frozen=True, slots=True, kw_only=True)
class BarHandle:
    """A bar on two posts that a parallel gripper can hold from the front, [m].

    Attributes:
        foot: Point of the front's plane behind the bar's middle (3,).
        axis: Unit direction of the bar (3,).
        clearance: Free depth between front and bar.
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
        half, radius = self.axis * self.length / 2, self.thickness / 2
        rods = [rod("bar", self.middle - half, self.middle + half, radius, surface)]
        for offset in self._post_offsets():
            rods.append(rod("post", self.foot + offset, self.middle + offset, POST * radius, surface, 10))
        return merge_meshes("handle", rods)

    def colliders(self, prefix: str = "") -> list[BoxCollider]:
        """Boxes of bar and posts; all names start with "handle", after a prefix for what does not move."""
        radius = self.thickness / 2
        half_bar = np.where(np.abs(self.axis) > 0.5, self.length / 2, radius)
        half_post = np.array([POST * radius, self.clearance / 2, POST * radius])
        rows = [("handle_bar", self.middle, half_bar)]
        for name, offset in zip(("handle_post_low", "handle_post_high"), self._post_offsets(), strict=True):
            rows.append((name, self.foot + OUTWARD * self.clearance / 2 + offset, half_post))
        return [
            BoxCollider(name=prefix + name, T_asset_box=transform(np.eye(3), centre), half_extents=half)
            for name, centre, half in rows
        ]

    def _post_offsets(self) -> tuple[Array, Array]:
        offset = self.axis * (self.length / 2 - POST * self.thickness)
        return -1.0 * offset, offset


def make_bar(s: SimpleNamespace, foot: ArrayLike, axis: Array, length: float) -> BarHandle:
    """A bar as thick and as far off as the drawn sizes say."""
    place = np.asarray(foot, np.float64)
    return BarHandle(
        foot=place, axis=axis, length=length, thickness=s.bar_thickness, clearance=s.bar_clearance
    )


class LinkBuilder:
    """A link under construction; what is added first comes first."""

    def __init__(self, name: str, *, mirrored: bool = False) -> None:
        """Where `mirrored`, boxes are given for one side and built for the other (x -> -x)."""
        self._name, self.mirrored = name, mirrored
        self.meshes: list[Mesh] = []
        self.colliders: list[BoxCollider] = []

    def across(self, x: float) -> float:
        """The x of a point that is given for one side, [m]."""
        return -x if self.mirrored else x

    def boxes(
        self, name: str, rows: Mapping[str, AlignedBox], surface: Material, *, symmetric: bool = False
    ) -> None:
        """One mesh of several boxes, each a collider of its own; `symmetric` ones are given for both sides."""
        sided = rows if symmetric else {key: self._sided(row) for key, row in rows.items()}
        self.meshes.append(boxes_mesh(name, list(sided.values()), surface))
        self.colliders += [row.collider(key) for key, row in sided.items()]

    def shell(self, name: str, rows: Sequence[AlignedBox], surface: Material) -> None:
        """One mesh of several boxes that nothing touches."""
        self.meshes.append(boxes_mesh(name, [self._sided(row) for row in rows], surface))

    def solid(self, name: str, row: AlignedBox) -> None:
        """A collider that nobody sees."""
        self.colliders.append(self._sided(row).collider(name))

    def print(
        self,
        name: str,
        face: str,
        corner: tuple[float, float, float],
        size: tuple[float, float],
        surface: Material,
    ) -> None:
        """A print of a size (width, height) on one of `FACES`; its lower left corner as seen from outside.

        Never mirrored.
        """
        right, up = (np.array(edge) for edge in FACES[face])
        place = corner + PRINT_GAP * np.cross(right, up)
        self.meshes.append(panel(name, place, size[0] * right, size[1] * up, surface))

    def bar(self, bar: BarHandle, surface: Material) -> None:
        """The handle."""
        self.meshes.append(bar.mesh(surface))
        self.colliders += bar.colliders()

    def link(self, mass: float) -> AssetLink:
        """The finished link; mass in [kg]."""
        return AssetLink(
            name=self._name, meshes=tuple(self.meshes), colliders=tuple(self.colliders), mass=mass
        )

    def _sided(self, row: AlignedBox) -> AlignedBox:
        return row.mirrored() if self.mirrored else row


def carcass(w: float, depth: Span, height: Span, board: float) -> dict[str, AlignedBox]:
    """Boards around a piece of furniture that is open to the front: `w` to both sides, front to back, floor to top."""
    (y0, y1), (z0, z1) = depth, height
    inside = (z0 + board, z1 - board)
    return {
        "top": box(-w, w, y0, y1, z1 - board, z1),
        "bottom": box(-w, w, y0, y1, z0, z0 + board),
        "left": box(-w, -w + board, y0, y1, *inside, "zZ"),
        "right": box(w - board, w, y0, y1, *inside, "zZ"),
        "back": box(-w + board, w - board, y1 - board, y1, *inside, "xXzZ"),
    }


def feet(w: float, depth: Span, height: float, *, inset: float, half: float) -> dict[str, AlignedBox]:
    """Four feet of half width `half`, their middles `inset` from the sides, [m]."""
    y0, y1 = depth
    places = [(x, y) for x in (-w + inset, w - inset) for y in (y0 + inset, y1 - inset)]
    return {
        f"foot_{i}": box(x - half, x + half, y - half, y + half, 0.0, height, "Z")
        for i, (x, y) in enumerate(places)
    }


def window_frame(x: Span, y: Span, z: Span, frame: float) -> list[AlignedBox]:
    """Four bars of width `frame` around a window, [m]."""
    (x0, x1), (z0, z1) = x, z
    inside = (z0 + frame, z1 - frame)
    return [
        box(x0, x1, *y, z0, z0 + frame),
        box(x0, x1, *y, z1 - frame, z1),
        box(x0, x0 + frame, *y, *inside, "zZ"),
        box(x1 - frame, x1, *y, *inside, "zZ"),
    ]


def lining(x: Span, y: Span, z: Span) -> list[AlignedBox]:
    """The sides, back, bottom and top of a hollow open to the front; their faces look inwards."""
    (x0, x1), (y0, y1), (z0, z1), thin = x, y, z, 0.001
    return [
        box(x0 - thin, x0, y0, y1, z0, z1, "xyYzZ"),
        box(x1, x1 + thin, y0, y1, z0, z1, "XyYzZ"),
        box(x0, x1, y1, y1 + thin, z0, z1, "xXYzZ"),
        box(x0, x1, y0, y1, z0 - thin, z0, "xXyYz"),
        box(x0, x1, y0, y1, z1, z1 + thin, "xXyYZ"),
    ]


def hinge(axis: ArrayLike, origin: ArrayLike, opening_deg: float) -> Joint:
    """A revolute joint that opens so far."""
    line, place = np.asarray(axis, np.float64), np.asarray(origin, np.float64)
    return Joint(type="revolute", axis=line, origin=place, lower=0.0, upper=np.deg2rad(opening_deg))


def slide(axis: ArrayLike, bar: BarHandle, travel: float) -> Joint:
    """A prismatic joint of a part that a bar is on; travel in [m]."""
    return Joint(
        type="prismatic", axis=np.asarray(axis, np.float64), origin=bar.foot, lower=0.0, upper=travel
    )


def assemble(
    category: str, static: AssetLink, moving: AssetLink, joint: Joint, held: BarHandle | Array
) -> ArticulatedAsset:
    """The asset, still without a name; it is held at a bar, or at a point (3,) of a level rim."""
    point, axis = (held.middle, held.axis) if isinstance(held, BarHandle) else (held, LEVEL)
    return ArticulatedAsset(
        name="", category=category, static=static, moving=moving, joint=joint, handle_point=point, handle_axis=axis
    )  # fmt: skip
