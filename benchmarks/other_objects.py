"""Objects beyond the product's categories, to test generalization: an oven, a cupboard."""

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from aomgen.assets.choice import MAKERS, OTHER_MAKERS, Maker, make_asset, make_by
from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import (
    LEVEL,
    SEAL,
    UPRIGHT,
    Color,
    LinkBuilder,
    assemble,
    carcass,
    draw_sizes,
    feet,
    hinge,
    lining,
    pick,
    pick_color,
    slide,
    window_frame,
)
from aomgen.assets.procedural.furniture import FELT, GAP, KEPT_IN, PLY, tray
from aomgen.assets.procedural.handles import OUTWARD, Handle, make_handle
from aomgen.assets.procedural.shapes import Material, box, merge_meshes, panel, rod
from aomgen.assets.procedural.textures import Texture
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import ConfigError

# Sizes [m], masses [kg], opening [deg], shares; the plinth leaves room below the opened door's handle.
OVEN = {
    "width": (0.42, 0.50),
    "height": (0.34, 0.40),
    "depth": (0.32, 0.38),
    "plinth": (0.085, 0.105),
    "strip": (0.050, 0.062),
    "wall": (0.012, 0.018),
    "door": (0.022, 0.030),
    "frame": (0.030, 0.040),
    "bar_share": (0.62, 0.78),
    "bar_thickness": (0.012, 0.016),
    "bar_clearance": (0.030, 0.036),
    "handle": "bar",
    "opening": (82, 90),
    "body_mass": (9.0, 13.0),
    "door_mass": (1.4, 2.0),
}
# Colors of typical bodies and doors, sRGB 0..1.
BODIES = ((0.72, 0.73, 0.74), (0.20, 0.21, 0.22), (0.86, 0.85, 0.82), (0.58, 0.18, 0.15), (0.40, 0.52, 0.50))
# Dark glass, steel, grey.
DOORS = ((0.12, 0.12, 0.13), (0.66, 0.67, 0.68), (0.18, 0.20, 0.22))
STEEL = Material(color_srgb=(0.70, 0.70, 0.72), metallic=0.8, roughness=0.3)
# Sizes [m], masses [kg], opening [deg].
CUPBOARD = {
    "depth": (0.30, 0.36),
    "width": (0.34, 0.42),
    "height": (0.36, 0.42),
    "feet": (0.012, 0.025),
    "board": (0.013, 0.017),
    "front": (0.014, 0.018),
    "drawer_height": (0.11, 0.13),
    "travel": (0.20, 0.27),
    "opening": (98, 110),
    "handle": "bar",
    "bar_length": (0.11, 0.14),
    "bar_thickness": (0.011, 0.015),
    "bar_clearance": (0.028, 0.034),
    "body_mass": (9.0, 12.0),
    "part_mass": (1.2, 1.8),
    "side": (0, 1),
    "door_moves": (0, 1),
}


def make_object(category: str, seed: int) -> ArticulatedAsset:
    """Make an asset of the product's categories, an oven or a cupboard.

    Raises:
        ConfigError: The category is unknown.
    """
    if category in OTHER_OBJECTS:
        return make_by(OTHER_OBJECTS[category], category, seed)
    if category in MAKERS | OTHER_MAKERS:
        return make_asset(category, seed)
    known = ", ".join([*MAKERS, *OTHER_MAKERS, *OTHER_OBJECTS])
    raise ConfigError("category", f"{category!r} is unknown", f"choose one of {known}")


def make_oven(rng: np.random.Generator) -> ArticulatedAsset:
    """Make an oven: a door hinged at its lower edge, a bar handle at its upper edge, dials above it."""
    s = draw_sizes(rng, OVEN)
    color, door_color = pick(rng, BODIES), pick(rng, DOORS)
    s.front, s.door_top = -s.depth / 2 - SEAL - s.door, s.height - s.strip - 0.003
    bar = make_handle(s, [0.0, s.front, s.door_top - s.frame / 2], LEVEL, s.bar_share * s.width)
    body, door = LinkBuilder("body"), LinkBuilder("door")
    _add_oven_body(body, s, color, rng)
    _add_cavity(body, s, rng)
    _add_oven_door(door, s, door_color, bar, rng)
    # The hinge is on the door's outer lower edge, so that the door swings clear of the plinth.
    joint = hinge(LEVEL, [0.0, s.front, s.plinth], s.opening)
    return assemble("oven", body.link(s.body_mass), door.link(s.door_mass), joint, bar)


def _add_oven_body(body: LinkBuilder, s: SimpleNamespace, color: Color, rng: np.random.Generator) -> None:
    w, y0, y1, wall, z0, z1 = s.width / 2, -s.depth / 2, s.depth / 2, s.wall, s.plinth, s.height
    below = z1 - s.strip
    sheet = textures.make_brushed_metal if rng.random() < 0.5 else textures.make_speckles
    shell = {
        # The plinth is set back, as the opened door's lower edge rotates into the space before it.
        "plinth": box(-w, w, y0, y1, 0.0, z0),
        "top": box(-w, w, y0, y1, below, z1),
        "left": box(-w, -w + wall, y0, y1, z0, below, "zZ"),
        "right": box(w - wall, w, y0, y1, z0, below, "zZ"),
        "back": box(-w + wall, w - wall, y1 - wall, y1, z0, below, "xXzZ"),
        "fascia": box(-w, w, s.front, y0, below, z1, "Y"),
    }
    body.boxes("shell", shell, Material(texture_srgb=sheet(rng, color), roughness=0.45, metallic=0.3))
    dials = Material(texture_srgb=draw_knobs(rng, color), roughness=0.35)
    plate, slots = (
        Material(texture_srgb=image) for image in (textures.label(rng), textures.vents(rng, color))
    )
    edge, z = 0.004, z0 + 0.05
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.0)
    name = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)
    size = (2 * (w - edge), s.strip - 2 * edge)
    body.print("dials", "front", (-w + edge, s.front, below + edge), size, dials)
    body.print("label", "top", (x, y, z1), (0.12, 0.075), plate)
    body.print("vents_left", "left", (-w, 0.06, z), (0.13, 0.08), slots)
    body.print("vents_right", "right", (w, -0.06, z), (0.13, 0.08), slots)
    body.print("brand", "front", (-0.05, y0, 0.02), (0.10, 0.022), name)


def _add_cavity(body: LinkBuilder, s: SimpleNamespace, rng: np.random.Generator) -> None:
    """Add a dark lining and a rack."""
    w, y0, y1, thin = s.width / 2 - s.wall, -s.depth / 2, s.depth / 2 - s.wall, 0.001
    z0, z1 = s.plinth, s.height - s.strip
    enamel = textures.make_speckles(rng, (0.22, 0.22, 0.24), 256)
    hollow = lining((-w, w), (y0, y1), (z0 + thin, z1 - thin))
    body.shell("cavity", hollow, Material(texture_srgb=enamel, roughness=0.4))
    z = (z0 + z1) / 2
    places = np.linspace(-w + 0.02, w - 0.02, 9)
    bars = [rod("bar", (x, y0 + 0.03, z), (x, y1 - 0.01, z), 0.003, STEEL, 8) for x in places]
    body.meshes.append(merge_meshes("rack", bars))


def _add_oven_door(
    door: LinkBuilder, s: SimpleNamespace, color: Color, bar: Handle, rng: np.random.Generator
) -> None:
    w, z0, z1, frame = s.width / 2, s.plinth, s.door_top, s.frame
    y = (s.front, s.front + s.door)
    sheet = Material(texture_srgb=textures.make_brushed_metal(rng, color), roughness=0.35, metallic=0.4)
    glass = Material(texture_srgb=textures.window(rng), roughness=0.1)
    steel = Material(texture_srgb=textures.make_brushed_metal(rng, (0.78, 0.78, 0.80), 256), metallic=0.8)
    name = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)
    door.shell("frame", window_frame((-w, w), y, (z0, z1), frame), sheet)
    size, up, inset = 2 * (w - frame), (0, 0, z1 - z0 - 2 * frame), 0.2 * s.door
    for key, x, right, depth in (
        ("window", -w + frame, size, y[0] + inset),
        ("window_inside", w - frame, -size, y[1] - inset),
    ):
        door.meshes.append(panel(key, (x, depth, z0 + frame), (right, 0, 0), up, glass))
    door.print("name", "front", (-0.045, y[0], z0 + 0.006), (0.09, 0.02), name)
    door.solid("door", box(-w, w, *y, z0, z1))
    door.handle(bar, steel)


def make_cupboard(rng: np.random.Generator) -> ArticulatedAsset:
    """Make a drawer above a hinged door; the one that does not move belongs to the static part."""
    s = draw_sizes(rng, CUPBOARD)
    s.right, s.shelf = s.side < 0.5, s.height - s.board - s.drawer_height
    s.start = -s.depth / 2 - GAP
    wood, paint = (
        Material(texture_srgb=textures.wood(rng, pick_color(rng, "wood")), roughness=0.55),
        pick_color(rng, "paint"),
    )
    metal = textures.make_brushed_metal(rng, pick_color(rng, "metal"), 256)
    s.metal = Material(texture_srgb=metal, metallic=0.8, roughness=0.3)
    body, drawer, door = LinkBuilder("cupboard"), LinkBuilder("drawer"), LinkBuilder("door")
    _add_boards(body, s, wood, rng)
    drawer_bar = _add_drawer(drawer, s, paint, rng)
    door_bar = _add_door(door, s, paint, rng)
    sign = 1.0 if s.right else -1.0
    moves = s.door_moves < 0.5
    joint = slide(OUTWARD, drawer_bar, min(s.travel, s.depth - KEPT_IN))
    if moves:
        joint = hinge([0.0, 0.0, sign], [sign * s.width / 2, s.start, s.shelf / 2], s.opening)
    moving, still, key = (door, drawer, "drawer") if moves else (drawer, door, "door")
    body.meshes += [replace(mesh, name=f"{key}_{mesh.name}") for mesh in still.meshes]
    body.colliders += [replace(item, name=f"{key}_{item.name}") for item in still.colliders]
    mass = s.body_mass + s.part_mass
    held = door_bar if moves else drawer_bar
    return assemble("cupboard", body.link(mass), moving.link(s.part_mass), joint, held)


def _add_boards(body: LinkBuilder, s: SimpleNamespace, wood: Material, rng: np.random.Generator) -> None:
    w, y0, y1, board, z0, z1 = s.width / 2, -s.depth / 2, s.depth / 2, s.board, s.feet, s.height
    boards = {
        **carcass(w, (y0, y1), (z0, z1), board),
        "shelf": box(-w + board, w - board, y0, y1 - board, s.shelf - board, s.shelf, "xXY"),
    }
    plate = Material(texture_srgb=textures.label(rng))
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.02)
    body.boxes("boards", boards, wood)
    body.boxes("feet", feet(w, (y0, y1), z0, inset=0.05, half=0.02), FELT)
    body.print("label", "top", (x, y, z1), (0.10, 0.0625), plate)
    body.print("label_left", "left", (-w, 0.05, z0 + 0.09), (0.08, 0.05), plate)
    body.print("label_right", "right", (w, -0.03, z0 + 0.12), (0.08, 0.05), plate)
    for key, x in (("plates_left", -0.08), ("plates_right", 0.08)):
        glaze = textures.make_speckles(rng, rng.uniform(0.4, 0.9, 3), 128)
        radius, count, low = rng.uniform(0.05, 0.065), int(rng.integers(3, 7)), z0 + board
        ends = [((x, 0.02, low + 0.011 * i), (x, 0.02, low + 0.011 * i + 0.008)) for i in range(count)]
        surface = Material(texture_srgb=glaze, roughness=0.3)
        radii = [radius * (1.0 - 0.06 * (i % 2)) for i in range(count)]
        pile = [rod("plate", *pair, size, surface, 22) for pair, size in zip(ends, radii, strict=True)]
        body.meshes.append(merge_meshes(key, pile))


def _add_drawer(drawer: LinkBuilder, s: SimpleNamespace, paint: Color, rng: np.random.Generator) -> Handle:
    w, low, top = s.width / 2, s.shelf, s.height - s.board
    inner = w - s.board - GAP
    face = box(-w + 0.002, w - 0.002, s.start - s.front, s.start, low - 0.004, top + 0.008)
    ply = Material(texture_srgb=textures.wood(rng, PLY, 256), roughness=0.6)
    sheet = Material(texture_srgb=textures.wood(rng, pick_color(rng, "wood")), roughness=0.5)
    sign = Material(texture_srgb=textures.nameplate(rng, paint, 64))
    drawer.boxes("front", {"front": face}, sheet)
    depth = (s.start, s.depth / 2 - s.board - 0.01)
    drawer.boxes("tray", tray((-inner, inner), depth, (low + GAP, top - 0.025), 0.010), ply)
    drawer.print("sign", "front", (-w + 0.02, face.lower[1], top - 0.03), (0.07, 0.0175), sign)
    return _bar(drawer, s, [0.0, face.lower[1], (low + top) / 2], LEVEL)


def _add_door(door: LinkBuilder, s: SimpleNamespace, paint: Color, rng: np.random.Generator) -> Handle:
    w, front = s.width / 2, s.start - s.front
    # The door ends a finger's width below the drawer's front, so that they do not rub.
    low, top = s.feet, s.shelf - 0.004 - GAP
    sheet = Material(texture_srgb=textures.make_speckles(rng, paint), roughness=0.5)
    art = Material(texture_srgb=textures.stickers(rng, paint, 320, 320, 5), roughness=0.6)
    door.boxes("door", {"door": box(-w + 0.002, w - 0.002, front, s.start, low, top)}, sheet)
    free, size = -1.0 if s.right else 1.0, 0.55 * min(2 * w, top - low)
    corner = (-free * 0.3 * w - size / 2, front, (low + top - size) / 2)
    door.print("print", "front", corner, (size, size), art)
    return _bar(door, s, [free * (w - 0.04), front, (low + top) / 2], UPRIGHT)


def _bar(link: LinkBuilder, s: SimpleNamespace, foot: list[float], axis: np.ndarray) -> Handle:
    bar = make_handle(s, foot, axis, s.bar_length)
    link.handle(bar, s.metal)
    return bar


def draw_knobs(rng: np.random.Generator, color_srgb: Color, width: int = 512, height: int = 96) -> Texture:
    """Draw the control strip of an oven: three dials with their scales, a clock, a name."""
    image = Image.new("RGB", (width, height), tuple(int(255 * c) for c in color_srgb))
    draw = ImageDraw.Draw(image)
    ink = (235, 235, 230) if float(np.mean(color_srgb)) < 0.5 else (30, 30, 34)
    for number in range(3):
        x, y, radius = width * (0.10 + 0.15 * number), height * 0.5, 0.27 * height
        for mark in range(9):
            angle = np.deg2rad(135 + 33.75 * mark)
            dx, dy = np.cos(angle), np.sin(angle)
            inner, outer = radius * 1.2, radius * 1.5
            draw.line((x + inner * dx, y + inner * dy, x + outer * dx, y + outer * dy), fill=ink, width=2)
        around = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(around, fill=(90, 90, 94), outline=ink, width=2)
        angle = rng.uniform(0, 2 * np.pi)
        tip = (x + radius * np.cos(angle), y + radius * np.sin(angle))
        draw.line((x, y, *tip), fill=(250, 250, 250), width=4)
    draw.rectangle((0.55 * width, 0.25 * height, 0.73 * width, 0.75 * height), fill=(8, 10, 12))
    clock = f"{rng.integers(1, 24)}:{rng.integers(0, 60):02d}"
    font = ImageFont.load_default(34)
    draw.text((0.64 * width, 0.5 * height), clock, fill=(250, 120, 60), font=font, anchor="mm")
    name = str(rng.choice(textures.WORDS))
    draw.text((0.87 * width, 0.5 * height), name, fill=ink, font=font, anchor="mm")
    return np.asarray(image)


OTHER_OBJECTS: Final[Mapping[str, Maker]] = {"cupboard": make_cupboard, "oven": make_oven}
