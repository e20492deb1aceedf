"""Microwave ovens: hollow body, window door on an upright hinge, bar handle, keypad."""

from types import SimpleNamespace

import numpy as np

from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import (
    SEAL,
    UPRIGHT,
    BarHandle,
    Color,
    LinkBuilder,
    assemble,
    design,
    draw_sizes,
    feet,
    hinge,
    lining,
    make_bar,
    pick_color,
    window_frame,
)
from aomgen.assets.procedural.shapes import Material, box, panel, rod
from aomgen.core.asset import ArticulatedAsset

RUBBER = Material(color_srgb=(0.07, 0.07, 0.07))


def make_microwave(rng: np.random.Generator) -> ArticulatedAsset:
    """One microwave; every size, color and print comes from `rng`."""
    s = draw_sizes(rng, design("microwave"))
    body_color, door_color = pick_color(rng, "microwave"), pick_color(rng, "microwave_door")
    s.door_width = s.width * s.door_share
    body, door = (LinkBuilder(name, mirrored=s.side < 0.5) for name in ("body", "door"))
    # The back and the front of the door, asset frame y.
    s.seam = -s.depth / 2 - SEAL
    s.front = s.seam - s.door
    foot = [body.across(-s.width / 2 + s.door_width - s.frame / 2), s.front, (s.feet + s.height) / 2]
    bar = make_bar(s, foot, UPRIGHT, s.bar_share * (s.height - s.feet))
    _add_body(body, s, body_color, rng)
    _add_cavity(body, s, rng)
    _add_prints(body, s, body_color, door_color, rng)
    _add_door(door, s, door_color, bar, rng)
    origin = [body.across(-s.width / 2), s.seam, s.height / 2]
    joint = hinge([0.0, 0.0, 1.0 if body.mirrored else -1.0], origin, s.opening)
    return assemble("microwave", body.link(s.body_mass), door.link(s.door_mass), joint, bar)


def _column(s: SimpleNamespace) -> float:
    """Side of the column beside the door, drawn with the hinge on the left."""
    return -(s.width / 2) + s.door_width + 0.003


def _add_body(body: LinkBuilder, s: SimpleNamespace, color: Color, rng: np.random.Generator) -> None:
    w, y0, y1 = s.width / 2, -s.depth / 2, s.depth / 2
    z0, z1, wall, column = s.feet, s.height, s.wall, _column(s)
    sheet = textures.brushed_metal if rng.random() < 0.6 else textures.speckled
    shell = {
        "wall_bottom": box(-w, w, y0, y1, z0, z0 + wall, "Z"),
        "wall_top": box(-w, w, y0, y1, z1 - wall, z1, "z"),
        "wall_hinge": box(-w, -w + wall, y0, y1, z0 + wall, z1 - wall, "XzZ"),
        "wall_back": box(-w + wall, w, y1 - wall, y1, z0 + wall, z1 - wall, "yzZx"),
        "column": box(column, w, y0, y1 - wall, z0 + wall, z1 - wall, "xYzZ"),
        # The front of the column stands flush with the door.
        "fascia": box(column, w, s.front, y0, z0, z1, "Y"),
    }
    body.boxes("shell", shell, Material(texture_srgb=sheet(rng, color), roughness=0.45, metallic=0.3))
    body.boxes("feet", feet(w, (y0, y1), z0, inset=0.04, half=0.014), RUBBER, symmetric=True)


def _add_cavity(body: LinkBuilder, s: SimpleNamespace, rng: np.random.Generator) -> None:
    """Inner lining and the turntable."""
    left, column, z0 = -(s.width / 2) + s.wall, _column(s), s.feet + s.wall
    hollow = lining((left, column), (-s.depth / 2, s.depth / 2 - s.wall), (z0, s.height - s.wall))
    enamel = textures.speckled(rng, (0.70, 0.70, 0.68), 256)
    body.shell("cavity", hollow, Material(texture_srgb=enamel, roughness=0.5))
    centre = np.array([body.across((left + column) / 2), 0.0, z0 + 0.004])
    radius = 0.42 * min(column + s.width / 2 - s.wall, s.depth - s.wall)
    plate = Material(texture_srgb=textures.plastic(rng, (0.55, 0.62, 0.62)), roughness=0.2)
    body.meshes.append(rod("turntable", centre, centre + np.array([0, 0, 0.008]), radius, plate, 28))


def _add_prints(
    body: LinkBuilder, s: SimpleNamespace, color: Color, panel_color: Color, rng: np.random.Generator
) -> None:
    """Keypad on the fascia, rating plate on the top, vents on both sides."""
    w, z0, z1, edge, column = s.width / 2, s.feet, s.height, 0.004, _column(s)
    keypad = Material(texture_srgb=textures.keypad(rng, panel_color), roughness=0.35)
    left = min(body.across(column), body.across(w)) + edge
    size = (w - column - 2 * edge, z1 - z0 - 2 * edge)
    body.print("keypad", "front", (left, s.front, z0 + edge), size, keypad)
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.0)
    plate = Material(texture_srgb=textures.label(rng))
    body.print("label", "top", (x, y, z1), (0.12, 0.075), plate)
    slots = Material(texture_srgb=textures.vents(rng, color))
    y, z = rng.uniform(-0.10, 0.0), z0 + rng.uniform(0.06, 0.10)
    body.print("vents_right", "right", (w, y, z), (0.13, 0.08), slots)
    body.print("vents_left", "left", (-w, y + 0.13, z), (0.13, 0.08), slots)
    body.print("label_side", "left", (-w, -0.04, z0 + 0.02), (0.07, 0.035), plate)


def _add_door(
    door: LinkBuilder, s: SimpleNamespace, color: Color, bar: BarHandle, rng: np.random.Generator
) -> None:
    x, y, z = (-s.width / 2, -s.width / 2 + s.door_width), (s.front, s.seam), (s.feet, s.height)
    grain = Material(texture_srgb=textures.plastic(rng, color), tile_m=0.5, roughness=0.35)
    glass = Material(texture_srgb=textures.window(rng), roughness=0.1)
    name = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)
    door.shell("frame", window_frame(x, y, z, s.frame), grain)
    left = min(door.across(x[0] + s.frame), door.across(x[1] - s.frame))
    size, low, inset = x[1] - x[0] - 2 * s.frame, z[0] + s.frame, 0.25 * s.door
    up = (0, 0, z[1] - z[0] - 2 * s.frame)
    door.meshes.append(panel("window", (left, s.front + inset, low), (size, 0, 0), up, glass))
    back = (left + size, s.seam - inset, low)
    door.meshes.append(panel("window_inside", back, (-size, 0, 0), up, glass))
    door.print("brand", "front", (left + size / 2 - 0.05, s.front, z[0] + 0.009), (0.10, 0.022), name)
    door.solid("door", box(*x, *y, *z))
    steel = textures.brushed_metal(rng, (0.78, 0.78, 0.80), 256)
    door.bar(bar, Material(texture_srgb=steel, metallic=0.8, roughness=0.3))
