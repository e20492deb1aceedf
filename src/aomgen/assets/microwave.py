"""A parametric microwave oven: hollow body, window door on a vertical hinge, bar handle, keypad."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.shapes import PRINT_GAP, AlignedBox, Material, box, boxes_mesh, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh

# Free depth between body and closed door, [m]: the seal that keeps colliders apart.
SEAL = 0.002
Span = tuple[float, float]
Color = tuple[float, float, float]
# Colors of usual bodies, sRGB 0..1; the maker's taste.
BODY_COLORS = (
    (0.72, 0.73, 0.74),
    (0.88, 0.87, 0.84),
    (0.20, 0.21, 0.22),
    (0.62, 0.16, 0.14),
    (0.55, 0.66, 0.70),
)
# Colors of usual doors (black, grey, white), sRGB 0..1.
DOOR_COLORS = ((0.10, 0.10, 0.11), (0.16, 0.17, 0.19), (0.80, 0.80, 0.79))


@dataclass(frozen=True, slots=True, kw_only=True)
class MicrowaveShape:
    """Sizes of one microwave, [m], [kg], drawn with the hinge on the left (-x)."""

    width: float
    height: float
    depth: float
    feet: float
    wall: float
    door_thickness: float
    door_width: float
    frame: float
    handle_thickness: float
    handle_clearance: float
    handle_share: float
    opening: float
    body_mass: float
    door_mass: float
    hinge_right: bool


def draw_shape(rng: np.random.Generator) -> MicrowaveShape:
    """Random but realistic sizes."""
    width = rng.uniform(0.45, 0.52)
    return MicrowaveShape(
        width=width,
        height=rng.uniform(0.26, 0.31),
        depth=rng.uniform(0.32, 0.38),
        feet=rng.uniform(0.008, 0.014),
        wall=rng.uniform(0.012, 0.018),
        door_thickness=rng.uniform(0.026, 0.036),
        door_width=width * rng.uniform(0.72, 0.78),
        frame=rng.uniform(0.034, 0.046),
        handle_thickness=rng.uniform(0.012, 0.016),
        handle_clearance=rng.uniform(0.028, 0.034),
        handle_share=rng.uniform(0.58, 0.72),
        opening=np.deg2rad(rng.uniform(100, 112)),
        body_mass=rng.uniform(8.0, 12.0),
        door_mass=rng.uniform(1.7, 2.3),
        hinge_right=bool(rng.random() < 0.5),
    )


def make_microwave(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One microwave; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    body_color = BODY_COLORS[rng.integers(len(BODY_COLORS))]
    door_color = DOOR_COLORS[rng.integers(len(DOOR_COLORS))]
    handle = _handle(shape)
    joint = Joint(
        type="revolute",
        axis=np.array([0.0, 0.0, 1.0 if shape.hinge_right else -1.0]),
        origin=np.array([_sided(shape, -shape.width / 2), -shape.depth / 2 - SEAL, shape.height / 2]),
        lower=0.0,
        upper=shape.opening,
    )
    return ArticulatedAsset(
        name=name,
        category="microwave",
        static=_body(shape, body_color, door_color, rng),
        moving=_door(shape, door_color, handle, rng),
        joint=joint,
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _sided(shape: MicrowaveShape, x: float) -> float:
    return -x if shape.hinge_right else x


def _side_box(shape: MicrowaveShape, x0: float, x1: float, y: Span, z: Span, skip: str = "") -> AlignedBox:
    """A box drawn for a left hinge, mirrored where the hinge is on the right."""
    if shape.hinge_right:
        x0, x1 = -x1, -x0
        skip = skip.translate(str.maketrans("xX", "Xx"))
    return box(x0, x1, y[0], y[1], z[0], z[1], skip)


def _handle(shape: MicrowaveShape) -> BarHandle:
    x = -shape.width / 2 + shape.door_width - shape.frame / 2
    middle = (shape.feet + shape.height) / 2
    return BarHandle(
        foot=np.array([_sided(shape, x), -shape.depth / 2 - SEAL - shape.door_thickness, middle]),
        axis=np.array([0.0, 0.0, 1.0]),
        length=shape.handle_share * (shape.height - shape.feet),
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )


def _body(shape: MicrowaveShape, color: Color, door_color: Color, rng: np.random.Generator) -> AssetLink:
    w, y0, y1 = shape.width / 2, -shape.depth / 2, shape.depth / 2
    z0, z1, wall = shape.feet, shape.height, shape.wall
    column = -w + shape.door_width + 0.003
    shell = {
        "wall_bottom": _side_box(shape, -w, w, (y0, y1), (z0, z0 + wall), "Z"),
        "wall_top": _side_box(shape, -w, w, (y0, y1), (z1 - wall, z1), "z"),
        "wall_hinge": _side_box(shape, -w, -w + wall, (y0, y1), (z0 + wall, z1 - wall), "XzZ"),
        "wall_back": _side_box(shape, -w + wall, w, (y1 - wall, y1), (z0 + wall, z1 - wall), "yzZx"),
        "column": _side_box(shape, column, w, (y0, y1 - wall), (z0 + wall, z1 - wall), "xYzZ"),
    }
    # The front of the column stands flush with the door.
    front = -shape.depth / 2 - SEAL - shape.door_thickness
    shell["fascia"] = _side_box(shape, column, w, (front, y0), (z0, z1), "Y")
    feet = {
        f"foot_{i}": box(x - 0.014, x + 0.014, y - 0.014, y + 0.014, 0.0, z0, "Z")
        for i, (x, y) in enumerate((x, y) for x in (-w + 0.04, w - 0.04) for y in (y0 + 0.04, y1 - 0.04))
    }
    sheet = textures.brushed_metal if rng.random() < 0.6 else textures.speckled
    painted = Material(texture_srgb=sheet(rng, color), roughness=0.45, metallic=0.3)
    meshes = [
        boxes_mesh("shell", list(shell.values()), painted),
        boxes_mesh("feet", list(feet.values()), Material(color_srgb=(0.07, 0.07, 0.07))),
        *_cavity(shape, column, rng),
        *_prints(shape, column, front, color, door_color, rng),
    ]
    solids = {**shell, **feet}
    colliders = tuple(solid.collider(key) for key, solid in solids.items())
    return AssetLink(name="body", meshes=tuple(meshes), colliders=colliders, mass=shape.body_mass)


def _cavity(shape: MicrowaveShape, column: float, rng: np.random.Generator) -> list[Mesh]:
    """Inner lining, whose faces look inwards, and the turntable."""
    w, wall, y0, y1 = shape.width / 2, shape.wall, -shape.depth / 2, shape.depth / 2
    z0, z1, thin = shape.feet + wall, shape.height - wall, 0.001
    inner = [
        _side_box(shape, -w + wall - thin, -w + wall, (y0, y1 - wall), (z0, z1), "xyYzZ"),
        _side_box(shape, column, column + thin, (y0, y1 - wall), (z0, z1), "XyYzZ"),
        _side_box(shape, -w + wall, column, (y1 - wall, y1 - wall + thin), (z0, z1), "xXYzZ"),
        _side_box(shape, -w + wall, column, (y0, y1 - wall), (z0 - thin, z0), "xXyYz"),
        _side_box(shape, -w + wall, column, (y0, y1 - wall), (z1, z1 + thin), "xXyYZ"),
    ]
    lining = Material(texture_srgb=textures.speckled(rng, (0.70, 0.70, 0.68), 256), roughness=0.5)
    centre = np.array([_sided(shape, (-w + wall + column) / 2), 0.0, z0 + 0.004])
    radius = 0.42 * min(column + w - wall, shape.depth - wall)
    plate = Material(texture_srgb=textures.plastic(rng, (0.55, 0.62, 0.62)), roughness=0.2)
    disc = rod("turntable", centre, centre + np.array([0, 0, 0.008]), radius, plate, 28)
    return [boxes_mesh("cavity", inner, lining), disc]


def _prints(
    shape: MicrowaveShape,
    column: float,
    front: float,
    color: Color,
    panel_color: Color,
    rng: np.random.Generator,
) -> list[Mesh]:
    """Keypad on the fascia, rating plate on the top, vents on both sides."""
    w, z0, z1 = shape.width / 2, shape.feet, shape.height
    edge = 0.004
    left = min(_sided(shape, column), _sided(shape, w)) + edge
    keys = panel(
        "keypad",
        (left, front - PRINT_GAP, z0 + edge),
        (w - column - 2 * edge, 0, 0),
        (0, 0, z1 - z0 - 2 * edge),
        Material(texture_srgb=textures.keypad(rng, panel_color), roughness=0.35),
    )
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.0)
    plate = Material(texture_srgb=textures.label(rng))
    label = panel("label", (x, y, z1 + PRINT_GAP), (0.12, 0, 0), (0, 0.075, 0), plate)
    slots = Material(texture_srgb=textures.vents(rng, color))
    y, z = rng.uniform(-0.10, 0.0), z0 + rng.uniform(0.06, 0.10)
    right_vents = panel("vents_right", (w + PRINT_GAP, y, z), (0, 0.13, 0), (0, 0, 0.08), slots)
    left_vents = panel("vents_left", (-w - PRINT_GAP, y + 0.13, z), (0, -0.13, 0), (0, 0, 0.08), slots)
    side = panel("label_side", (-w - PRINT_GAP, -0.04, z0 + 0.02), (0, -0.07, 0), (0, 0, 0.035), plate)
    return [keys, label, right_vents, left_vents, side]


def _door(shape: MicrowaveShape, color: Color, handle: BarHandle, rng: np.random.Generator) -> AssetLink:
    x0, x1 = -shape.width / 2, -shape.width / 2 + shape.door_width
    back, z0, z1 = -shape.depth / 2 - SEAL, shape.feet, shape.height
    front, frame = back - shape.door_thickness, shape.frame
    inset = 0.25 * shape.door_thickness
    depth = (front, back)
    rim = [
        _side_box(shape, x0, x1, depth, (z0, z0 + frame)),
        _side_box(shape, x0, x1, depth, (z1 - frame, z1)),
        _side_box(shape, x0, x0 + frame, depth, (z0 + frame, z1 - frame), "zZ"),
        _side_box(shape, x1 - frame, x1, depth, (z0 + frame, z1 - frame), "zZ"),
    ]
    grain = Material(texture_srgb=textures.plastic(rng, color), tile_m=0.5, roughness=0.35)
    glass = Material(texture_srgb=textures.window(rng), roughness=0.1)
    left = min(_sided(shape, x0 + frame), _sided(shape, x1 - frame))
    size = x1 - x0 - 2 * frame
    up = (0, 0, z1 - z0 - 2 * frame)
    name_x = left + size / 2 - 0.05
    print_surface = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)
    metal = Material(
        texture_srgb=textures.brushed_metal(rng, (0.78, 0.78, 0.80), 256), metallic=0.8, roughness=0.3
    )
    meshes = (
        boxes_mesh("frame", rim, grain),
        panel("window", (left, front + inset, z0 + frame), (size, 0, 0), up, glass),
        panel("window_inside", (left + size, back - inset, z0 + frame), (-size, 0, 0), up, glass),
        panel("brand", (name_x, front - PRINT_GAP, z0 + 0.009), (0.10, 0, 0), (0, 0, 0.022), print_surface),
        handle.mesh(metal),
    )
    slab = _side_box(shape, x0, x1, depth, (z0, z1)).collider("door")
    return AssetLink(name="door", meshes=meshes, colliders=(slab, *handle.colliders()), mass=shape.door_mass)
