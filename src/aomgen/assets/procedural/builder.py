"""Common parts of all parametric designs: sampling of sizes, construction of links, bases and joints.

A design consists of a table of sizes in `designs.toml`, some rows of which are replaced by each style, and a function
that lists boxes, prints and rods in the asset frame: front toward -y, centered in x, standing on z = 0.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.procedural.handles import Handle
from aomgen.assets.procedural.shapes import (
    PRINT_GAP,
    AlignedBox,
    Material,
    RoundedBox,
    box,
    boxes_mesh,
    merge_meshes,
    panel,
)
from aomgen.core.asset import ArticulatedAsset, AssetLink, BoxCollider
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh
from aomgen.core.values import Array

Span = tuple[float, float]
Color = tuple[float, float, float]
Item = TypeVar("Item")
LEVEL, _, UPRIGHT = np.eye(3)
# Gap between the body and the closed part, which separates their colliders, [m].
SEAL: Final = 0.002
# Directions to the right and up on each face of an object, as seen from outside.
FACES: Final = {
    "front": ((1, 0, 0), (0, 0, 1)),
    "top": ((1, 0, 0), (0, 1, 0)),
    "left": ((0, -1, 0), (0, 0, 1)),
    "right": ((0, 1, 0), (0, 0, 1)),
}
# Key of a category's table that holds its styles; all other keys are sizes.
STYLES: Final = "styles"
# Protrusion of corner posts, and recess of a plinth, [m].
POST_OUT, PLINTH_INSET = 0.006, 0.025


@cache
def design(name: str) -> Mapping[str, Any]:
    """Read a table of `designs.toml`.

    Raises:
        KeyError: There is no such table.
    """
    return tomllib.loads((Path(__file__).parent / "designs.toml").read_text("utf-8"))[name]


def style_table(category: str, style: str) -> dict[str, Any]:
    """Return the rows of a category with the replacements of a style, in the order of the category's table."""
    table = dict(design(category))
    changes = table.pop(STYLES)[style]
    return table | changes


def draw_sizes(rng: np.random.Generator, table: Mapping[str, Any]) -> SimpleNamespace:
    """Sample one number uniformly from the range of each row, in the order of the table.

    A row with a number or a string is copied. If a row is a table of tables, one of these is chosen at random, and its rows
    are sampled and added to the result.
    """
    sizes: dict[str, Any] = {}
    for name, row in table.items():
        if isinstance(row, Mapping):
            sizes |= vars(draw_sizes(rng, row[pick(rng, list(row))]))
        else:
            sizes[name] = row if isinstance(row, str | int | float) else rng.uniform(*row)
    return SimpleNamespace(**sizes)


def pick(rng: np.random.Generator, options: Sequence[Item]) -> Item:
    """Choose one of several options with equal probability."""
    return options[int(rng.integers(len(options)))]


def pick_color(rng: np.random.Generator, kind: str) -> Color:
    """Choose one of the colors of a kind in `designs.toml`, sRGB 0..1."""
    return pick(rng, design("colors")[kind])


class LinkBuilder:
    """Builder of a link; meshes and colliders are in the order in which they are added."""

    def __init__(self, name: str, *, mirrored: bool = False) -> None:
        """Start an empty link.

        Args:
            name: Name of the link.
            mirrored: Mirror all boxes that are not symmetric at the plane x = 0.
        """
        self._name, self.mirrored = name, mirrored
        self.meshes: list[Mesh] = []
        self.colliders: list[BoxCollider] = []

    def across(self, x: float) -> float:
        """Return the x coordinate of a point, negated if the link is mirrored, [m]."""
        return -x if self.mirrored else x

    def boxes(
        self, name: str, rows: Mapping[str, AlignedBox], surface: Material, *, symmetric: bool = False
    ) -> None:
        """Add one mesh of several boxes, each with its collider.

        Args:
            name: Name of the mesh.
            rows: Boxes by the names of their colliders.
            surface: Material of the mesh.
            symmetric: The boxes are symmetric as a whole, so they are never mirrored.
        """
        sided = rows if symmetric else {key: self._orient(row) for key, row in rows.items()}
        self.meshes.append(boxes_mesh(name, list(sided.values()), surface))
        self.colliders += [row.collider(key) for key, row in sided.items()]

    def shell(self, name: str, rows: Sequence[AlignedBox], surface: Material) -> None:
        """Add one mesh of several boxes without colliders."""
        self.meshes.append(boxes_mesh(name, [self._orient(row) for row in rows], surface))

    def solid(self, name: str, row: AlignedBox) -> None:
        """Add an invisible collider."""
        self.colliders.append(self._orient(row).collider(name))

    def print(
        self,
        name: str,
        face: str,
        corner: tuple[float, float, float],
        size: tuple[float, float],
        surface: Material,
    ) -> None:
        """Add a print to a face of the object; prints are never mirrored.

        Args:
            name: Name of the mesh.
            face: One of `FACES`.
            corner: Lower left corner of the print as seen from outside (3,), [m].
            size: Width and height, [m].
            surface: Material with the printed image.
        """
        right, up = (np.array(edge) for edge in FACES[face])
        place = corner + PRINT_GAP * np.cross(right, up)
        self.meshes.append(panel(name, place, size[0] * right, size[1] * up, surface))

    def add_rounded(self, rows: Mapping[str, RoundedBox], surface: Material, *, name: str = "") -> None:
        """Add rounded boxes with colliders as one mesh, by default with the name of the first; they are never mirrored."""
        meshes = [row.mesh(key, surface) for key, row in rows.items()]
        self.meshes.append(merge_meshes(name or meshes[0].name, meshes))
        for key, row in rows.items():
            for number, part in enumerate(row.boxes()):
                self.colliders.append(part.collider(f"{key}_{number}" if number else key))

    def handle(self, handle: Handle, surface: Material) -> None:
        """Add the handle of the asset."""
        self.meshes.append(handle.mesh(surface))
        self.colliders += handle.colliders()

    def behind(self, name: str, handle: Handle, surface: Material) -> None:
        """Add a second handle, which is not the held one, at the back, rotated by 180 degrees about z."""
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        self.meshes.append(replace(handle.mesh(surface), name=name).transform(turn))
        for part in handle.colliders(f"{name}_"):
            self.colliders.append(replace(part, T_asset_box=turn @ part.T_asset_box))

    def link(self, mass: float) -> AssetLink:
        """Build the link with a mass, [kg]."""
        return AssetLink(
            name=self._name, meshes=tuple(self.meshes), colliders=tuple(self.colliders), mass=mass
        )

    def _orient(self, row: AlignedBox) -> AlignedBox:
        return row.mirror() if self.mirrored else row


def carcass(w: float, depth: Span, height: Span, board: float) -> dict[str, AlignedBox]:
    """List the boards of a body that is open to the front.

    Args:
        w: Half width, [m].
        depth: Front and back (y), [m].
        height: Bottom and top (z), [m].
        board: Thickness of the boards, [m].
    """
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
    """List the boxes of four feet.

    Args:
        w: Half width of the body, [m].
        depth: Front and back of the body (y), [m].
        height: Height of the feet, [m].
        inset: Distance of the centers of the feet from the sides of the body, [m].
        half: Half width of the feet, [m].
    """
    y0, y1 = depth
    places = [(x, y) for x in (-w + inset, w - inset) for y in (y0 + inset, y1 - inset)]
    return {
        f"foot_{i}": box(x - half, x + half, y - half, y + half, 0.0, height, "Z")
        for i, (x, y) in enumerate(places)
    }


def stand(
    kind: str, w: float, depth: Span, height: float, inset: float, half: float
) -> dict[str, AlignedBox]:
    """List the boxes of the base of a body.

    Args:
        kind: "blocks" (see `feet`), "legs" at the corners, "rails" along the sides, "plinth"; anything else is no base.
        w: Half width of the body, [m].
        depth: Front and back of the body (y), [m].
        height: Height of the base, [m].
        inset: Distance of blocks and rails from the sides, [m].
        half: Half width of blocks, legs and rails, [m].
    """
    y0, y1 = depth
    if kind == "legs":
        return feet(w, depth, height, inset=half, half=half)
    if kind == "rails":
        return {
            f"rail_{i}": box(x - half, x + half, y0 + half, y1, 0.0, height, "Z")
            for i, x in enumerate((-w + inset, w - inset))
        }
    if kind == "plinth":
        back = PLINTH_INSET
        return {"plinth": box(-w + back, w - back, y0 + back, y1, 0.0, height, "Z")}
    return feet(w, depth, height, inset=inset, half=half) if kind == "blocks" else {}


def corner_posts(w: float, depth: Span, height: Span, side: float) -> dict[str, AlignedBox]:
    """List posts around the four vertical edges of a body, from which they protrude by POST_OUT.

    Args:
        w: Half width of the body, [m].
        depth, height: Spans of the body in y and z, [m].
        side: Width of the posts, [m].
    """
    (y0, y1), out, inside = depth, POST_OUT, side - POST_OUT
    posts = {}
    for end, y in (("front", (y0 - out, y0 + inside)), ("back", (y1 - inside, y1 + out))):
        posts[f"post_left_{end}"] = box(-w - out, -w + inside, *y, *height)
        posts[f"post_right_{end}"] = box(w - inside, w + out, *y, *height)
    return posts


def window_frame(x: Span, y: Span, z: Span, frame: float) -> list[AlignedBox]:
    """List four bars around a window.

    Args:
        x, y, z: Outer spans of the bars, [m].
        frame: Width of the bars, [m].
    """
    (x0, x1), (z0, z1) = x, z
    inside = (z0 + frame, z1 - frame)
    return [
        box(x0, x1, *y, z0, z0 + frame),
        box(x0, x1, *y, z1 - frame, z1),
        box(x0, x0 + frame, *y, *inside, "zZ"),
        box(x1 - frame, x1, *y, *inside, "zZ"),
    ]


def lining(x: Span, y: Span, z: Span) -> list[AlignedBox]:
    """List thin boxes around the spans (x, y, z), [m], of a cavity that is open to the front; only inner faces are visible."""
    (x0, x1), (y0, y1), (z0, z1), thin = x, y, z, 0.001
    return [
        box(x0 - thin, x0, y0, y1, z0, z1, "xyYzZ"),
        box(x1, x1 + thin, y0, y1, z0, z1, "XyYzZ"),
        box(x0, x1, y1, y1 + thin, z0, z1, "xXYzZ"),
        box(x0, x1, y0, y1, z0 - thin, z0, "xXyYz"),
        box(x0, x1, y0, y1, z1, z1 + thin, "xXyYZ"),
    ]


def hinge(axis: ArrayLike, origin: ArrayLike, opening_deg: float) -> Joint:
    """Build a revolute joint from its axis (3,), a point on it (3,), [m], and its opening angle, [deg]."""
    line, place = np.asarray(axis, np.float64), np.asarray(origin, np.float64)
    return Joint(type="revolute", axis=line, origin=place, lower=0.0, upper=np.deg2rad(opening_deg))


def slide(axis: ArrayLike, handle: Handle, travel: float) -> Joint:
    """Build the prismatic joint of a part with a handle from its axis (3,) and its travel, [m]."""
    return Joint(
        type="prismatic", axis=np.asarray(axis, np.float64), origin=handle.foot, lower=0.0, upper=travel
    )


def assemble(
    category: str, static: AssetLink, moving: AssetLink, joint: Joint, held: Handle | Array
) -> ArticulatedAsset:
    """Build an asset with an empty name.

    Args:
        category: Category of the asset.
        static, moving: Links, asset frame.
        joint: Joint, asset frame.
        held: Handle at which the asset is held, or grasp point (3,) on a horizontal rim, [m].
    """
    point, axis = (held.middle, held.axis) if isinstance(held, Handle) else (held, LEVEL)
    return ArticulatedAsset(
        name="", category=category, static=static, moving=moving, joint=joint, handle_point=point, handle_axis=axis
    )  # fmt: skip
