"""The room of a synthetic capture: floor, wall with posters, table with clutter, pedestal."""

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from aomgen.assets.mjcf import add_visual_mesh
from aomgen.assets.shapes import Box, Surface, box, boxes_mesh, panel
from aomgen.assets.textures import brushed_metal
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array, freeze
from aomgen.synthetic import prints

TABLE_GEOM = "table"


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Sizes of a room in its own frame: robot at the origin, table and object towards +y, Z up.

    Attributes:
        T_world_room: Pose (4, 4); a turn about z.
        table_z: Height of the table top, [m].
        table: (x0, x1, y0, y1) of the table top, [m].
        keep_free: (x0, x1, y0, y1) of the table that stays without clutter, [m].
        wall_y: Plane of the wall, [m].
        floor_z: Height of the floor, [m].
    """

    T_world_room: Array
    table_z: float
    table: tuple[float, float, float, float]
    keep_free: tuple[float, float, float, float]
    wall_y: float
    floor_z: float

    def __post_init__(self) -> None:
        freeze(self, "T_world_room", self.T_world_room, (4, 4))


def add_room(spec: mujoco.MjSpec, room: Room, rng: np.random.Generator, *, visual: bool) -> None:
    """Add the room to a model: the table top as a collider, everything else only when `visual`."""
    T = room.T_world_room
    body = spec.worldbody.add_body(name="room", pos=T[:3, 3], quat=quat_from_matrix(T[:3, :3]))
    x0, x1, y0, y1 = room.table
    body.add_geom(
        name=TABLE_GEOM,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[(x0 + x1) / 2, (y0 + y1) / 2, room.table_z - 0.02],
        size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.02],
        group=3,
    )
    if not visual:
        return
    for mesh in room_meshes(room, rng):
        add_visual_mesh(spec, body, mesh, f"room_{mesh.name}")
    # A steep lamp casts the shadows; the others only shade, so that every picture sees one light.
    lights = {
        "lamp": ((-0.10, 0.18, -1.0), 0.45, True),
        "window": ((0.8, 0.5, -0.45), 0.26, False),
        "door": ((-0.5, 0.75, -0.35), 0.20, False),
    }
    for name, (direction, strength, shadow) in lights.items():
        body.add_light(
            name=name,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0.0, 0.4, 2.5],
            dir=direction,
            diffuse=[strength] * 3,
            specular=[0.3 * strength] * 3,
            ambient=[0.0] * 3,
            castshadow=shadow,
        )


def room_meshes(room: Room, rng: np.random.Generator) -> list[Mesh]:
    """All visible meshes, room frame."""
    floor = Surface(texture_srgb=prints.tiles(rng), tile_m=3.0)
    wall = Surface(texture_srgb=prints.plaster(rng), tile_m=3.0)
    top = Surface(texture_srgb=prints.table_top(rng), tile_m=1.5, roughness=0.5)
    dark = Surface(texture_srgb=brushed_metal(rng, (0.23, 0.23, 0.25), 256), tile_m=1.0)
    steel = Surface(texture_srgb=brushed_metal(rng, (0.60, 0.60, 0.62), 512), tile_m=0.4)
    x0, x1, y0, y1 = room.table
    z, down, back = room.table_z, room.floor_z, room.wall_y
    legs = [
        box(x - 0.025, x + 0.025, y - 0.025, y + 0.025, down, z - 0.04)
        for x in (x0 + 0.05, x1 - 0.05)
        for y in (y0 + 0.05, y1 - 0.05)
    ]
    meshes = [
        panel("floor", (-2.2, back - 4.4, down), (4.4, 0, 0), (0, 4.4, 0), floor),
        panel("wall", (-2.2, back, down), (4.4, 0, 0), (0, 0, 2.9), wall),
        panel("wall_left", (-2.2, back - 4.4, down), (0, 4.4, 0), (0, 0, 2.9), wall),
        panel("wall_right", (2.2, back, down), (0, -4.4, 0), (0, 0, 2.9), wall),
        panel("wall_behind", (2.2, back - 4.4, down), (-4.4, 0, 0), (0, 0, 2.9), wall),
        boxes_mesh("top", [box(x0, x1, y0, y1, z - 0.04, z)], top),
        boxes_mesh("legs", legs, dark),
        boxes_mesh("pedestal", [box(-0.13, 0.13, -0.13, 0.13, down, -0.022)], dark),
        boxes_mesh("plate", [box(-0.16, 0.16, -0.16, 0.16, -0.022, -0.002)], steel),
    ]
    return [*meshes, *_posters(room, rng), *_clutter(room, rng)]


def _posters(room: Room, rng: np.random.Generator) -> list[Mesh]:
    """Posters on all four walls, densest behind the table; no two are the same."""
    back, near = room.wall_y - 0.004, room.wall_y - 4.396
    walls = [
        ((-1.9, back), (1.0, 0.0), (0.05, 0.22)),
        ((-2.196, near + 0.3), (0.0, 1.0), (0.2, 0.6)),
        ((2.196, back - 0.3), (0.0, -1.0), (0.2, 0.6)),
        ((1.9, near), (-1.0, 0.0), (0.3, 0.8)),
    ]
    meshes: list[Mesh] = []
    for (x, y), (dx, dy), gaps in walls:
        along = rng.uniform(0.0, 0.2)
        while along < 3.4:
            width = rng.uniform(0.36, 0.56)
            height = width * rng.uniform(1.15, 1.4)
            corner = (x + along * dx, y + along * dy, room.table_z + rng.uniform(0.05, 0.45))
            surface = Surface(texture_srgb=prints.poster(rng), roughness=0.9)
            right = (width * dx, width * dy, 0.0)
            meshes.append(panel(f"poster_{len(meshes)}", corner, right, (0, 0, height), surface))
            along += width + rng.uniform(*gaps)
    return meshes


def _clutter(room: Room, rng: np.random.Generator) -> list[Mesh]:
    """Cartons behind, books and magazines wherever the table is not kept free."""
    x0, x1, y0, y1 = room.table
    meshes: list[Mesh] = []
    taken = [room.keep_free]
    wanted = [*["carton"] * 3, *["book"] * 3, *["magazine"] * 6]
    for kind in wanted:
        for _ in range(60):
            a, b, c = _size(kind, rng)
            # Cartons stand at the back, where they hide little.
            front = y0 + (0.55 * (y1 - y0) if kind == "carton" else 0.02)
            x, y = rng.uniform(x0 + 0.02, x1 - a - 0.02), rng.uniform(front, y1 - b - 0.02)
            area = (x, x + a, y, y + b)
            if not any(_meet(area, other) for other in taken):
                taken.append(area)
                z = room.table_z + 0.0005
                meshes += printed_box(f"{kind}_{len(taken)}", box(x, x + a, y, y + b, z, z + c), kind, rng)
                break
    return meshes


def _size(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    if kind == "carton":
        a, b, c = rng.uniform((0.14, 0.12, 0.10), (0.24, 0.20, 0.20))
    elif kind == "book":
        a, b, c = rng.uniform((0.13, 0.16, 0.015), (0.19, 0.23, 0.04))
    else:
        a, b, c = rng.uniform((0.15, 0.18, 0.003), (0.22, 0.26, 0.006))
    return float(a), float(b), float(c)


def _meet(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    gap = 0.02
    return a[0] < b[1] + gap and b[0] < a[1] + gap and a[2] < b[3] + gap and b[2] < a[3] + gap


def printed_box(name: str, solid: Box, kind: str, rng: np.random.Generator) -> list[Mesh]:
    """A box with another print on every visible face, so that no two faces can be confused."""
    (x0, y0, z0), (x1, y1, z1) = solid.lower, solid.upper
    draw = prints.carton if kind == "carton" else prints.poster
    top = Surface(texture_srgb=draw(rng), roughness=0.8)
    meshes = [panel(f"{name}_top", (x0, y0, z1), (x1 - x0, 0, 0), (0, y1 - y0, 0), top)]
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    plain = Surface(color_srgb=(0.88, 0.86, 0.82))
    for number, ((ax, ay), (bx, by)) in enumerate(pairwise(ring)):
        side = Surface(texture_srgb=prints.carton(rng), roughness=0.8) if kind == "carton" else plain
        edge = (bx - ax, by - ay, 0)
        meshes.append(panel(f"{name}_{number}", (ax, ay, z0), edge, (0, 0, z1 - z0), side))
    return meshes
