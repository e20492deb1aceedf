"""A parametric oven: door hinged at its lower edge, bar handle across its upper edge, dials above it."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import decals, textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.shapes import PRINT_GAP, AlignedBox, Material, box, boxes_mesh, merge_meshes, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh

# Free depth between body and closed door, [m]: the seal that keeps colliders apart.
SEAL = 0.002
# Colors of usual bodies and doors, sRGB 0..1; the maker's taste.
BODIES = ((0.72, 0.73, 0.74), (0.20, 0.21, 0.22), (0.86, 0.85, 0.82), (0.58, 0.18, 0.15), (0.40, 0.52, 0.50))
# Dark glass, steel, grey.
DOORS = ((0.12, 0.12, 0.13), (0.66, 0.67, 0.68), (0.18, 0.20, 0.22))


@dataclass(frozen=True, slots=True, kw_only=True)
class OvenShape:
    """Sizes of one oven, [m], [rad], [kg]."""

    width: float
    height: float
    depth: float
    plinth: float
    strip: float
    wall: float
    door: float
    frame: float
    handle_share: float
    handle_thickness: float
    handle_clearance: float
    opening: float
    body_mass: float
    door_mass: float

    @property
    def front(self) -> float:
        """Outer plane of the closed door, asset frame y."""
        return -self.depth / 2 - SEAL - self.door

    @property
    def door_top(self) -> float:
        """Upper edge of the closed door."""
        return self.height - self.strip - 0.003


def draw_shape(rng: np.random.Generator) -> OvenShape:
    """Random but realistic sizes; the plinth leaves room below the opened door's handle."""
    return OvenShape(
        width=rng.uniform(0.42, 0.50),
        height=rng.uniform(0.34, 0.40),
        depth=rng.uniform(0.32, 0.38),
        plinth=rng.uniform(0.085, 0.105),
        strip=rng.uniform(0.050, 0.062),
        wall=rng.uniform(0.012, 0.018),
        door=rng.uniform(0.022, 0.030),
        frame=rng.uniform(0.030, 0.040),
        handle_share=rng.uniform(0.62, 0.78),
        handle_thickness=rng.uniform(0.012, 0.016),
        handle_clearance=rng.uniform(0.030, 0.036),
        opening=np.deg2rad(rng.uniform(82, 90)),
        body_mass=rng.uniform(9.0, 13.0),
        door_mass=rng.uniform(1.4, 2.0),
    )


def make_oven(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One oven; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    color, door_color = BODIES[rng.integers(len(BODIES))], DOORS[rng.integers(len(DOORS))]
    handle = BarHandle(
        foot=np.array([0.0, shape.front, shape.door_top - shape.frame / 2]),
        axis=np.array([1.0, 0.0, 0.0]),
        length=shape.handle_share * shape.width,
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )
    joint = Joint(
        type="revolute",
        axis=np.array([1.0, 0.0, 0.0]),
        # On the door's outer lower edge, so that the door swings clear of the plinth.
        origin=np.array([0.0, shape.front, shape.plinth]),
        lower=0.0,
        upper=shape.opening,
    )
    return ArticulatedAsset(
        name=name,
        category="oven",
        static=_body(shape, color, rng),
        moving=_door(shape, door_color, handle, rng),
        joint=joint,
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _body(shape: OvenShape, color: tuple[float, float, float], rng: np.random.Generator) -> AssetLink:
    w, y0, y1, wall = shape.width / 2, -shape.depth / 2, shape.depth / 2, shape.wall
    z0, z1 = shape.plinth, shape.height
    shell = {
        # The plinth stands back, as the opened door's lower edge turns into the room before it.
        "plinth": box(-w, w, y0, y1, 0.0, z0),
        "top": box(-w, w, y0, y1, z1 - shape.strip, z1),
        "left": box(-w, -w + wall, y0, y1, z0, z1 - shape.strip, "zZ"),
        "right": box(w - wall, w, y0, y1, z0, z1 - shape.strip, "zZ"),
        "back": box(-w + wall, w - wall, y1 - wall, y1, z0, z1 - shape.strip, "xXzZ"),
        "fascia": box(-w, w, shape.front, y0, z1 - shape.strip, z1, "Y"),
    }
    sheet = textures.brushed_metal if rng.random() < 0.5 else textures.speckled
    painted = Material(texture_srgb=sheet(rng, color), roughness=0.45, metallic=0.3)
    dials = Material(texture_srgb=decals.knobs(rng, color), roughness=0.35)
    plate = Material(texture_srgb=textures.label(rng))
    slots = Material(texture_srgb=textures.vents(rng, color))
    edge = 0.004
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.0)
    z = z0 + 0.05
    meshes = (
        boxes_mesh("shell", list(shell.values()), painted),
        panel(
            "dials",
            (-w + edge, shape.front - PRINT_GAP, z1 - shape.strip + edge),
            (2 * (w - edge), 0, 0),
            (0, 0, shape.strip - 2 * edge),
            dials,
        ),
        panel("label", (x, y, z1 + PRINT_GAP), (0.12, 0, 0), (0, 0.075, 0), plate),
        panel("vents_left", (-w - PRINT_GAP, 0.06, z), (0, -0.13, 0), (0, 0, 0.08), slots),
        panel("vents_right", (w + PRINT_GAP, -0.06, z), (0, 0.13, 0), (0, 0, 0.08), slots),
        panel("brand", (-0.05, y0 - PRINT_GAP, 0.02), (0.10, 0, 0), (0, 0, 0.022), _name(rng, color)),
        *_cavity(shape, rng),
    )
    colliders = tuple(solid.collider(key) for key, solid in shell.items())
    return AssetLink(name="body", meshes=meshes, colliders=colliders, mass=shape.body_mass)


def _name(rng: np.random.Generator, color: tuple[float, float, float]) -> Material:
    return Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)


def _cavity(shape: OvenShape, rng: np.random.Generator) -> list[Mesh]:
    """Dark lining, whose faces look inwards, and a rack."""
    w, wall, y0, y1 = shape.width / 2 - shape.wall, 0.001, -shape.depth / 2, shape.depth / 2 - shape.wall
    z0, z1 = shape.plinth, shape.height - shape.strip
    inner = [
        box(-w - wall, -w, y0, y1, z0, z1, "xyYzZ"),
        box(w, w + wall, y0, y1, z0, z1, "XyYzZ"),
        box(-w, w, y1, y1 + wall, z0, z1, "xXYzZ"),
        box(-w, w, y0, y1, z0, z0 + wall, "xXyYz"),
        box(-w, w, y0, y1, z1 - wall, z1, "xXyYZ"),
    ]
    enamel = Material(texture_srgb=textures.speckled(rng, (0.22, 0.22, 0.24), 256), roughness=0.4)
    steel = Material(color_srgb=(0.70, 0.70, 0.72), metallic=0.8, roughness=0.3)
    z = (z0 + z1) / 2
    bars = [
        rod("bar", (x, y0 + 0.03, z), (x, y1 - 0.01, z), 0.003, steel, 8)
        for x in np.linspace(-w + 0.02, w - 0.02, 9)
    ]
    return [boxes_mesh("cavity", inner, enamel), merge_meshes("rack", bars)]


def _door(
    shape: OvenShape, color: tuple[float, float, float], handle: BarHandle, rng: np.random.Generator
) -> AssetLink:
    w, z0, z1, frame = shape.width / 2, shape.plinth, shape.door_top, shape.frame
    y = (shape.front, shape.front + shape.door)
    rim: list[AlignedBox] = [
        box(-w, w, *y, z0, z0 + frame),
        box(-w, w, *y, z1 - frame, z1),
        box(-w, -w + frame, *y, z0 + frame, z1 - frame, "zZ"),
        box(w - frame, w, *y, z0 + frame, z1 - frame, "zZ"),
    ]
    sheet = Material(texture_srgb=textures.brushed_metal(rng, color), roughness=0.35, metallic=0.4)
    glass = Material(texture_srgb=textures.window(rng), roughness=0.1)
    steel = Material(texture_srgb=textures.brushed_metal(rng, (0.78, 0.78, 0.80), 256), metallic=0.8)
    size, up = 2 * (w - frame), (0, 0, z1 - z0 - 2 * frame)
    inset = 0.2 * shape.door
    meshes = (
        boxes_mesh("frame", rim, sheet),
        panel("window", (-w + frame, y[0] + inset, z0 + frame), (size, 0, 0), up, glass),
        panel("window_inside", (w - frame, y[1] - inset, z0 + frame), (-size, 0, 0), up, glass),
        panel("name", (-0.045, y[0] - PRINT_GAP, z0 + 0.006), (0.09, 0, 0), (0, 0, 0.02), _name(rng, color)),
        handle.mesh(steel),
    )
    slab = box(-w, w, *y, z0, z1).collider("door")
    return AssetLink(name="door", meshes=meshes, colliders=(slab, *handle.colliders()), mass=shape.door_mass)
