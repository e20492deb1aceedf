"""Parametric microwave ovens: hollow body, door with window, vertical hinge and handle, keypad next to the door.

The keypad is beside, below or above the door, depending on the style.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import (
    SEAL,
    UPRIGHT,
    Color,
    LinkBuilder,
    Span,
    assemble,
    draw_sizes,
    hinge,
    lining,
    pick_color,
    stand,
    window_frame,
)
from aomgen.assets.procedural.handles import Handle, make_handle
from aomgen.assets.procedural.shapes import (
    ALL_EDGES,
    UPPER_EDGES,
    AlignedBox,
    Material,
    RoundedBox,
    box,
    panel,
    rod,
)
from aomgen.core.asset import ArticulatedAsset

# Gap between door and keypad; depth of the frame around the front; distance of the feet from the sides, [m].
DOOR_GAP, TRIM_DEPTH, FOOT_INSET = 0.003, 0.022, 0.04
STEEL = Material(color_srgb=(0.62, 0.62, 0.64), metallic=0.7, roughness=0.35)
RUBBER = Material(color_srgb=(0.07, 0.07, 0.07))


def make_microwave(rng: np.random.Generator, table: Mapping[str, Any]) -> ArticulatedAsset:
    """Make a microwave oven.

    Args:
        rng: Generator of sizes, colors and prints.
        table: Rows of a style, see `builder.style_table`.

    Returns:
        The closed asset in the asset frame, with an empty name.
    """
    s = draw_sizes(rng, table)
    body_color, door_color = pick_color(rng, "microwave"), pick_color(rng, "microwave_door")
    body, door = (LinkBuilder(name, mirrored=s.side < 0.5) for name in ("body", "door"))
    # `seam` and `front` are the y coordinates of the door's back and front, asset frame.
    s.seam = -s.depth / 2 - SEAL
    s.front = s.seam - s.door
    _lay_out(s)
    (_, x1), (z0, z1) = s.door_rect
    foot = [body.across(x1 - s.frame / 2), s.front, (z0 + z1) / 2]
    handle = make_handle(s, foot, UPRIGHT, s.bar_share * (z1 - z0))
    _add_body(body, s, body_color, rng)
    _add_cavity(body, s, rng)
    _add_prints(body, s, body_color, door_color, rng)
    _add_door(door, s, door_color, handle, rng)
    origin = [body.across(-s.width / 2), s.seam, s.height / 2]
    joint = hinge([0.0, 0.0, 1.0 if body.mirrored else -1.0], origin, s.opening)
    return assemble("microwave", body.link(s.body_mass), door.link(s.door_mass), joint, handle)


def _lay_out(s: SimpleNamespace) -> None:
    """Set the spans (x, z) of door, keypad panel and cavity for a hinge on the left, [m]."""
    w, z0, z1, wall = s.width / 2, s.feet, s.height, s.wall
    across, inner, inside = (-w, w), (-w + wall, w - wall), (z0 + wall, z1 - wall)
    panel_height = (1.0 - s.door_share) * (z1 - z0)
    if s.keys == "beside":
        edge = -w + s.door_share * s.width
        column = edge + DOOR_GAP
        s.door_rect, s.panel_rect = ((-w, edge), (z0, z1)), ((column, w), (z0, z1))
        s.cavity = (-w + wall, column), inside
    elif s.keys == "below":
        seam = z0 + panel_height
        s.door_rect, s.panel_rect = (across, (seam + DOOR_GAP, z1)), (across, (z0, seam))
        s.cavity = inner, (seam, inside[1])
    else:
        seam = z1 - panel_height
        s.door_rect, s.panel_rect = (across, (z0, seam - DOOR_GAP)), (across, (seam, z1))
        s.cavity = inner, (inside[0], seam)


def _round(s: SimpleNamespace, row: AlignedBox) -> RoundedBox:
    """Round those edges of a box along y that are corners of the microwave as seen from the front."""
    corners = [
        c for c in ALL_EDGES if (row.upper[2] == s.height if c in UPPER_EDGES else row.lower[2] == s.feet)
    ]
    return RoundedBox(whole=row, axis=1, radii=(s.corner, s.corner), corners=tuple(corners))


def _add_body(body: LinkBuilder, s: SimpleNamespace, color: Color, rng: np.random.Generator) -> None:
    w, y0, y1 = s.width / 2, -s.depth / 2, s.depth / 2
    z0, z1, wall = s.feet, s.height, s.wall
    (cx0, cx1), (cz0, cz1) = s.cavity
    (px0, px1), (pz0, pz1) = s.panel_rect
    sheet = textures.make_brushed_metal if rng.random() < 0.6 else textures.make_speckles
    level = {
        "wall_bottom": box(-w, w, y0, y1, z0, cz0, "Z"),
        "wall_top": box(-w, w, y0, y1, cz1, z1, "z"),
    }
    upright = {
        "wall_hinge": box(-w, cx0, y0, y1, cz0, cz1, "XzZ"),
        "wall_back": box(cx0, w, y1 - wall, y1, cz0, cz1, "yzZx"),
        "column": box(cx1, w, y0, y1 - wall, cz0, cz1, "xYzZ"),
    }
    # The keypad panel is flush with the front of the door.
    fascia = {"fascia": box(px0, px1, s.front, y0, pz0, pz1, "Y")}
    surface = Material(texture_srgb=sheet(rng, color), roughness=0.45, metallic=0.3)
    if s.corner > 0:
        body.boxes("sides", upright, surface)
        body.add_rounded(
            {key: _round(s, row) for key, row in (level | fascia).items()}, surface, name="shell"
        )
    else:
        body.boxes("shell", level | upright | fascia, surface)
    if s.trim > 0:
        edge, y = w + s.trim, (y0, y0 + TRIM_DEPTH)
        frame = {
            "trim_top": box(-edge, edge, *y, z1, z1 + s.trim),
            "trim_left": box(-edge, -w, *y, z0, z1, "Z"),
            "trim_right": box(w, edge, *y, z0, z1, "Z"),
        }
        body.boxes("trim", frame, STEEL, symmetric=True)
    base = stand(s.stand, w, (y0, y1), z0, FOOT_INSET, s.foot_half)
    body.boxes("feet", base, RUBBER, symmetric=True)


def _add_cavity(body: LinkBuilder, s: SimpleNamespace, rng: np.random.Generator) -> None:
    """Add the lining of the cavity and the turntable."""
    (left, column), (z0, z1) = s.cavity
    hollow = lining((left, column), (-s.depth / 2, s.depth / 2 - s.wall), (z0, z1))
    enamel = textures.make_speckles(rng, (0.70, 0.70, 0.68), 256)
    body.shell("cavity", hollow, Material(texture_srgb=enamel, roughness=0.5))
    centre = np.array([body.across((left + column) / 2), 0.0, z0 + 0.004])
    radius = 0.42 * min(column - left, s.depth - s.wall)
    plate = Material(texture_srgb=textures.plastic(rng, (0.55, 0.62, 0.62)), roughness=0.2)
    body.meshes.append(rod("turntable", centre, centre + np.array([0, 0, 0.008]), radius, plate, 28))


def _add_prints(
    body: LinkBuilder, s: SimpleNamespace, color: Color, panel_color: Color, rng: np.random.Generator
) -> None:
    """Add the keypad on its panel, rating plates on the top and a side, and vents on both sides."""
    w, z0, z1, edge = s.width / 2, s.feet, s.height, 0.004
    (px0, px1), (pz0, pz1) = s.panel_rect
    draw = textures.keypad if s.keys == "beside" else textures.key_strip
    keys = Material(texture_srgb=draw(rng, panel_color), roughness=0.35)
    inset = edge + s.corner
    left = min(body.across(px0), body.across(px1)) + inset
    size = (px1 - px0 - 2 * inset, pz1 - pz0 - 2 * edge)
    body.print("keypad", "front", (left, s.front, pz0 + edge), size, keys)
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.0)
    plate = Material(texture_srgb=textures.label(rng))
    body.print("label", "top", (x, y, z1), (0.12, 0.075), plate)
    slots = Material(texture_srgb=textures.vents(rng, color))
    y, z = rng.uniform(-0.10, 0.0), z0 + rng.uniform(0.06, 0.10)
    body.print("vents_right", "right", (w, y, z), (0.13, 0.08), slots)
    body.print("vents_left", "left", (-w, y + 0.13, z), (0.13, 0.08), slots)
    body.print("label_side", "left", (-w, -0.04, z0 + 0.02), (0.07, 0.035), plate)


def _add_door(
    door: LinkBuilder, s: SimpleNamespace, color: Color, handle: Handle, rng: np.random.Generator
) -> None:
    (x, z), y = s.door_rect, (s.front, s.seam)
    grain = Material(texture_srgb=textures.plastic(rng, color), tile_m=0.5, roughness=0.35)
    glass = Material(texture_srgb=textures.window(rng), roughness=0.1)
    name = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.35)
    _add_frame(door, s, (x, y, z), grain)
    left = min(door.across(x[0] + s.frame), door.across(x[1] - s.frame))
    size, low, inset = x[1] - x[0] - 2 * s.frame, z[0] + s.frame, 0.25 * s.door
    up = (0, 0, z[1] - z[0] - 2 * s.frame)
    door.meshes.append(panel("window", (left, s.front + inset, low), (size, 0, 0), up, glass))
    back = (left + size, s.seam - inset, low)
    door.meshes.append(panel("window_inside", back, (-size, 0, 0), up, glass))
    door.print("brand", "front", (left + size / 2 - 0.05, s.front, z[0] + 0.009), (0.10, 0.022), name)
    steel = textures.make_brushed_metal(rng, (0.78, 0.78, 0.80), 256)
    door.handle(handle, Material(texture_srgb=steel, metallic=0.8, roughness=0.3))


def _add_frame(
    door: LinkBuilder, s: SimpleNamespace, spans: tuple[Span, Span, Span], grain: Material
) -> None:
    """Add bars around the window, and one collider for frame and window; round corners need additional colliders."""
    bars = window_frame(*spans, s.frame)
    if s.corner == 0:
        door.shell("frame", bars, grain)
        (x0, x1), (y0, y1), (z0, z1) = spans
        door.solid("door", box(x0, x1, y0, y1, z0, z1))
        return
    low, top, *uprights = bars
    door.shell("uprights", uprights, grain)
    middle = replace(low, lower=(*low.lower[:2], low.upper[2]), upper=(*top.upper[:2], top.lower[2]))
    door.solid("door", middle)
    door.add_rounded({"frame_low": _round(s, low), "frame_top": _round(s, top)}, grain, name="frame")
