"""Small objects on a synthetic table: cartons, books, clutter around a laptop, and the mat below it."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from aomgen.assets.procedural.builder import pick_color
from aomgen.assets.procedural.shapes import (
    AlignedBox,
    Material,
    box,
    boxes_mesh,
    dome,
    merge_meshes,
    panel,
    rod,
)
from aomgen.assets.procedural.textures import make_speckles, plastic
from aomgen.core.mesh import Mesh
from synthetic import printed_textures

# Low and high sizes along x, y and z, [m].
SIZES: Final = {
    "carton": ((0.14, 0.12, 0.10), (0.24, 0.20, 0.20)),
    "book": ((0.13, 0.16, 0.015), (0.19, 0.23, 0.04)),
    "magazine": ((0.15, 0.18, 0.003), (0.22, 0.26, 0.006)),
    "mug": ((0.11, 0.078, 0.085), (0.125, 0.090, 0.105)),
    "adapter": ((0.05, 0.10, 0.025), (0.065, 0.13, 0.032)),
    "mouse": ((0.056, 0.095, 0.032), (0.066, 0.115, 0.040)),
}
# Objects stand this far above the table, so that no two surfaces are drawn in one place, [m].
ABOVE: Final = 0.0005
# Thickness of a mat, [m]: the laptop's feet are higher; and the edge of its print, [m].
MAT, MAT_PRINT = 0.0008, 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class TabletopObject:
    """One object on the table: a key of `SIZES`, and the box around it, room frame, [m]."""

    kind: str
    solid: AlignedBox

    @property
    def area(self) -> tuple[float, float, float, float]:
        """x0, x1, y0, y1 of the table that it covers, [m]."""
        (x0, y0, _), (x1, y1, _) = self.solid.lower, self.solid.upper
        return x0, x1, y0, y1


def draw_object_on_table(
    kind: str,
    spans: tuple[tuple[float, float], tuple[float, float]],
    table_z: float,
    taken: list[tuple[float, float, float, float]],
    rng: np.random.Generator,
) -> TabletopObject | None:
    """An object of a kind between low and high x and y; None where it finds no free place in a few tries.

    Areas (x0, x1, y0, y1) that are taken stay free, [m].
    """
    for _ in range(60):
        a, b, c = (float(size) for size in rng.uniform(*SIZES[kind]))
        (x0, x1), (y0, y1) = spans
        x, y = rng.uniform(x0, max(x1 - a, x0)), rng.uniform(y0, max(y1 - b, y0))
        area = (x, x + a, y, y + b)
        if area[1] <= x1 and area[3] <= y1 and not any(_meet(area, other) for other in taken):
            z = table_z + ABOVE
            return TabletopObject(kind=kind, solid=box(*area, z, z + c))
    return None


def make_object_meshes(name: str, thing: TabletopObject, rng: np.random.Generator) -> list[Mesh]:
    """Meshes of an object; every mesh's name starts with `name`."""
    if thing.kind in ("mug", "adapter", "mouse"):
        return {"mug": _mug, "adapter": _adapter, "mouse": _mouse}[thing.kind](name, thing.solid, rng)
    return _printed_box(name, thing, rng)


def make_mat_mesh(area: tuple[float, float, float, float], table_z: float, rng: np.random.Generator) -> Mesh:
    """A striped mat, a checked cloth or a wooden board on an area (x0, x1, y0, y1) of the table, [m]."""
    draw = (printed_textures.striped, printed_textures.checked, printed_textures.planks)[rng.integers(3)]
    x0, x1, y0, y1 = area
    slab = box(x0, x1, y0, y1, table_z, table_z + MAT, "z")
    return boxes_mesh("mat", [slab], Material(texture_srgb=draw(rng), tile_m=MAT_PRINT, roughness=0.9))


def _meet(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    gap = 0.02
    return a[0] < b[1] + gap and b[0] < a[1] + gap and a[2] < b[3] + gap and b[2] < a[3] + gap


def _printed_box(name: str, thing: TabletopObject, rng: np.random.Generator) -> list[Mesh]:
    """A box with another print on every visible face, so that no two faces can be confused."""
    (x0, y0, z0), (x1, y1, z1) = thing.solid.lower, thing.solid.upper
    carton = thing.kind == "carton"
    draw = printed_textures.carton if carton else printed_textures.poster
    top = Material(texture_srgb=draw(rng), roughness=0.8)
    meshes = [panel(f"{name}_top", (x0, y0, z1), (x1 - x0, 0, 0), (0, y1 - y0, 0), top)]
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    plain = Material(color_srgb=(0.88, 0.86, 0.82))
    for number, ((ax, ay), (bx, by)) in enumerate(pairwise(ring)):
        side = Material(texture_srgb=printed_textures.carton(rng), roughness=0.8) if carton else plain
        edge = (bx - ax, by - ay, 0)
        meshes.append(panel(f"{name}_{number}", (ax, ay, z0), edge, (0, 0, z1 - z0), side))
    return meshes


def _mug(name: str, solid: AlignedBox, rng: np.random.Generator) -> list[Mesh]:
    """A cylinder full of coffee with an angular handle towards +x."""
    (x0, y0, z0), (x1, y1, z1) = solid.lower, solid.upper
    radius, height = (y1 - y0) / 2, z1 - z0
    x, y = x0 + radius, (y0 + y1) / 2
    glaze = Material(texture_srgb=make_speckles(rng, pick_color(rng, "mug"), 256), roughness=0.3)
    coffee = Material(color_srgb=(0.16, 0.09, 0.05))
    low, high = z0 + 0.25 * height, z0 + 0.8 * height
    wall, grip = x + 0.95 * radius, x1 - 0.005
    corners = [(wall, y, low), (grip, y, low), (grip, y, high), (wall, y, high)]
    rods = [rod("part", a, b, 0.005, glaze, 8) for a, b in pairwise(corners)]
    body = rod("part", (x, y, z0), (x, y, z1), radius, glaze, 28)
    top = rod(f"{name}_coffee", (x, y, z1), (x, y, z1 + 0.0006), 0.9 * radius, coffee, 28)
    return [merge_meshes(name, [body, *rods]), top]


def _adapter(name: str, solid: AlignedBox, rng: np.random.Generator) -> list[Mesh]:
    """A power adapter with its two cables."""
    (x0, y0, z0), (x1, y1, z1) = solid.lower, solid.upper
    black = Material(texture_srgb=plastic(rng, (0.11, 0.11, 0.12), 128), roughness=0.5)
    x, bend = (x0 + x1) / 2, rng.uniform(-0.06, 0.06)
    cable = 0.0025
    meshes = [boxes_mesh(name, [box(x0, x1, y0, y1, z0, z1)], black)]
    for side, (y, way) in enumerate(((y0, -1.0), (y1, 1.0))):
        points = [
            (x, y, z0 + cable),
            (x + 0.4 * bend, y + 0.03 * way, z0 + cable),
            (x + bend, y + 0.06 * way, z0 + cable),
        ]
        rods = [rod("part", a, b, cable, black, 8) for a, b in pairwise(points)]
        meshes.append(merge_meshes(f"{name}_cable_{side}", rods))
    return meshes


def _mouse(name: str, solid: AlignedBox, rng: np.random.Generator) -> list[Mesh]:
    """A computer mouse: a dome with a dark wheel."""
    (x0, y0, z0), (x1, y1, z1) = solid.lower, solid.upper
    center = ((x0 + x1) / 2, (y0 + y1) / 2, z0)
    shell = Material(texture_srgb=plastic(rng, pick_color(rng, "mouse"), 128), roughness=0.4)
    dark = Material(color_srgb=(0.05, 0.05, 0.06))
    y, z = center[1] + 0.22 * (y1 - y0), z0 + 0.85 * (z1 - z0)
    wheel = rod(f"{name}_wheel", (center[0] - 0.003, y, z), (center[0] + 0.003, y, z), 0.008, dark, 12)
    return [dome(name, center, ((x1 - x0) / 2, (y1 - y0) / 2, z1 - z0), shell), wheel]
