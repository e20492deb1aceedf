"""The room of a synthetic capture: floor, wall with posters, table with clutter, pedestal."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.mjcf import COLLIDER_GROUP, add_visual_mesh
from aomgen.assets.procedural.shapes import Material, box, boxes_mesh, panel
from aomgen.assets.procedural.textures import make_brushed_metal
from aomgen.core.mesh import Mesh
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Matrix4, freeze_arrays
from aomgen.simulation.scene_spec import TABLE
from synthetic import printed_textures
from synthetic.tabletop_objects import (
    TabletopObject,
    draw_object_on_table,
    make_mat_mesh,
    make_object_meshes,
)

# Room for the gripper before an object, [m]; part of what is kept free.
FRONT_M: Final = 0.25
# Distance beyond the free area within which clutter around an object may lie, and a mat may reach, [m].
BESIDE_M, MAT_BEYOND_M = 0.17, 0.15
# Share of the tables with a low object that have a mat; others are bare.
MAT_SHARE: Final = 0.85


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Sizes of a room in its own frame, [m]: robot at the origin, table and object towards +y, Z up.

    Attributes:
        T_world_room: A turn about z.
        table: (x0, x1, y0, y1) of the table top.
        keep_free: (x0, x1, y0, y1) of the table that stays without clutter; the first FRONT_M of y
            are the gripper's.
        desk: Whether the object lies on a mat or on the bare table with small clutter around it.
    """

    T_world_room: Matrix4
    table_z: float
    table: tuple[float, float, float, float]
    keep_free: tuple[float, float, float, float]
    desk: bool
    wall_y: float
    floor_z: float

    __post_init__ = freeze_arrays


def add_room(spec: mujoco.MjSpec, room: Room, rng: np.random.Generator, *, visual: bool) -> None:
    """Add the room to a model: table top and clutter around the object as colliders, else only when `visual`."""
    T = room.T_world_room
    body = spec.worldbody.add_body(name="room", pos=T[:3, 3], quat=quat_from_matrix(T[:3, :3]))
    x0, x1, y0, y1 = room.table
    half = [(x1 - x0) / 2, (y1 - y0) / 2, 0.02]
    _add_solid(body, TABLE, [(x0 + x1) / 2, (y0 + y1) / 2, room.table_z - 0.02], half)
    things = _beside(room, rng) if room.desk else []
    for number, thing in enumerate(things):
        low, high = np.array(thing.solid.lower), np.array(thing.solid.upper)
        _add_solid(body, f"{thing.kind}_{number}", (low + high) / 2, (high - low) / 2)
    if not visual:
        return
    for mesh in make_room_meshes(room, things, rng):
        add_visual_mesh(spec, body, mesh, f"room_{mesh.name}")
    # A steep light casts the shadows; the others only shade, so that every image shows one light.
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


def _add_solid(body: mujoco.MjsBody, name: str, middle: ArrayLike, half: ArrayLike) -> None:
    kind = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name=name, type=kind, pos=middle, size=half, group=COLLIDER_GROUP)


def make_room_meshes(room: Room, things: list[TabletopObject], rng: np.random.Generator) -> list[Mesh]:
    """All visible meshes, room frame, with the clutter around the object."""
    floor = Material(texture_srgb=printed_textures.tiles(rng), tile_m=3.0)
    wall = Material(texture_srgb=printed_textures.plaster(rng), tile_m=3.0)
    top = Material(texture_srgb=printed_textures.table_top(rng), tile_m=1.5, roughness=0.5)
    dark = Material(texture_srgb=make_brushed_metal(rng, (0.23, 0.23, 0.25), 256), tile_m=1.0)
    steel = Material(texture_srgb=make_brushed_metal(rng, (0.60, 0.60, 0.62), 512), tile_m=0.4)
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
    taken = [room.keep_free]
    if room.desk:
        taken += [thing.area for thing in things]
        for number, thing in enumerate(things):
            meshes += make_object_meshes(f"beside_{number}", thing, rng)
        if rng.random() < MAT_SHARE:
            meshes.append(make_mat_mesh(_mat_area(room, rng), room.table_z, rng))
    return [*meshes, *_posters(room, rng), *_clutter(room, taken, rng)]


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
            surface = Material(texture_srgb=printed_textures.poster(rng), roughness=0.9)
            right = (width * dx, width * dy, 0.0)
            meshes.append(panel(f"poster_{len(meshes)}", corner, right, (0, 0, height), surface))
            along += width + rng.uniform(*gaps)
    return meshes


def _clutter(
    room: Room, taken: list[tuple[float, float, float, float]], rng: np.random.Generator
) -> list[Mesh]:
    """Cartons behind, books and magazines wherever the table is not kept free."""
    x0, x1, y0, y1 = room.table
    meshes: list[Mesh] = []
    taken = list(taken)
    for kind in [*["carton"] * 3, *["book"] * 3, *["magazine"] * 6]:
        # Cartons stand at the back, where they hide little.
        front = y0 + (0.55 * (y1 - y0) if kind == "carton" else 0.02)
        spans = ((x0 + 0.02, x1 - 0.02), (front, y1 - 0.02))
        thing = draw_object_on_table(kind, spans, room.table_z, taken, rng)
        if thing is not None:
            taken.append(thing.area)
            meshes += make_object_meshes(f"{kind}_{len(taken)}", thing, rng)
    return meshes


def _beside(room: Room, rng: np.random.Generator) -> list[TabletopObject]:
    """A mug, a mouse, a power adapter and a book close to what stands on the mat."""
    x0, x1, y0, y1 = room.keep_free
    table = room.table
    ring = (
        (max(x0 - BESIDE_M, table[0]), min(x1 + BESIDE_M, table[1])),
        (max(y0 + FRONT_M, table[2]), min(y1 + BESIDE_M, table[3])),
    )
    things: list[TabletopObject] = []
    for kind in rng.permutation(["mug", "mouse", "adapter", "book"]):
        taken = [room.keep_free, *(thing.area for thing in things)]
        thing = draw_object_on_table(str(kind), ring, room.table_z, taken, rng)
        if thing is not None:
            things.append(thing)
    return things


def _mat_area(room: Room, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Rectangle of the table under a mat: all that the object needs, and some more, up to the table's edge."""
    x0, x1, y0, y1 = room.keep_free
    left, right, front, back = rng.uniform(0.0, MAT_BEYOND_M, 4)
    table = room.table
    return (
        max(float(x0 - left), table[0] + 0.01),
        min(float(x1 + right), table[1] - 0.01),
        max(float(y0 + FRONT_M - front), table[2] + 0.01),
        min(float(y1 + back), table[3] - 0.01),
    )
