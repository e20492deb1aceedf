"""Parametric objects with a lid hinged at the back: toolboxes held at a handle, laptops held at the rim of the lid."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import (
    LEVEL,
    SEAL,
    Color,
    LinkBuilder,
    Span,
    assemble,
    corner_posts,
    draw_sizes,
    hinge,
    pick_color,
    stand,
)
from aomgen.assets.procedural.handles import ArchHandle, Handle, make_handle
from aomgen.assets.procedural.shapes import (
    PRINT_GAP,
    UPPER_EDGES,
    AlignedBox,
    Material,
    RoundedBox,
    box,
    merge_meshes,
    panel,
    rod,
)
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint

# Height of a latch on the body; width and depth of the rims of trays; clearance below the back of the open lid, [m].
LATCH, BAND, BAND_OUT, POST_ROOM = 0.034, 0.014, 0.006, 0.012
# Distance of a toolbox's feet from the sides, and their half width; margin around prints, [m].
FOOT_INSET, FOOT_HALF, PRINT_EDGE = 0.05, 0.016, 0.03
# Smallest height of the vertical edge of a rounded or beveled lid; inset of the upper step of a lid, [m].
LEAST_CROWN, TIER_INSET = 0.002, 0.03
# Height of a carrying handle above the lid, [m], and its half length as a share of the width.
CARRY, CARRY_SHARE = 0.04, 0.16
# Share of a laptop's depth that is tapered; shares of its half width that the rear block and the ridge on the lid span.
WEDGE_SHARE, TAIL_SHARE, RIDGE_SHARE = 0.75, 0.72, 0.6
# Recess of a laptop's sides from its front, [m].
WING_INSET = 0.03
# Height of the rubber strips below a laptop, depth of the rim of its lid, and distance of the grasp point from the edge, [m].
STRIPS, RIM, HELD = 0.002, 0.016, 0.004
IRON = Material(color_srgb=(0.62, 0.63, 0.66), metallic=0.8, roughness=0.35)
RUBBER = Material(color_srgb=(0.10, 0.10, 0.11))
BLACK = Material(color_srgb=(0.06, 0.06, 0.07))
BEZEL = Material(color_srgb=(0.05, 0.05, 0.06))


def make_toolbox(rng: np.random.Generator, table: Mapping[str, Any]) -> ArticulatedAsset:
    """Make a closed toolbox: a hollow body with a tray of tools, latches, and a lid that may have a carrying handle.

    Args:
        rng: Generator of sizes, colors and prints.
        table: Rows of a style, see `builder.style_table`.
    """
    s = draw_sizes(rng, table)
    body_color, lid_color = pick_color(rng, "toolbox"), pick_color(rng, "lid")
    s.seam += s.feet
    s.low = s.seam + SEAL
    # Height at which the vertical walls of the lid end.
    s.eaves = s.low + s.lid - s.crown
    handle = make_handle(s, [0.0, -s.depth / 2, (s.low + s.eaves) / 2], LEVEL, s.bar_length)
    body, lid = LinkBuilder("body"), LinkBuilder("lid")
    _add_toolbox_body(body, s, body_color, lid_color, rng)
    _add_tools(body, s, rng)
    _add_toolbox_lid(lid, s, lid_color, handle, rng)
    return assemble("toolbox", body.link(s.body_mass), lid.link(s.lid_mass), _back_hinge(s), handle)


def _back_hinge(s: SimpleNamespace) -> Joint:
    """Build the hinge half a seal behind the back, so that the lid does not collide with the body when it opens."""
    return hinge([-1.0, 0.0, 0.0], [0.0, s.depth / 2 + SEAL / 2, s.seam + SEAL / 2], s.opening)


def _add_toolbox_body(
    body: LinkBuilder, s: SimpleNamespace, color: Color, lid_color: Color, rng: np.random.Generator
) -> None:
    w, front = s.width / 2, -s.depth / 2
    plastic = _tread_plate(rng, color, roughness=0.5, metallic=0.2)
    steel = _steel(rng)
    sticker = Material(texture_srgb=textures.label(rng), roughness=0.5)
    brand = Material(texture_srgb=textures.nameplate(rng, lid_color), roughness=0.4)
    x, z = rng.uniform(-0.13, -0.10), s.feet + rng.uniform(0.012, 0.022)
    body.boxes("body", _walls(s, s.feet, s.seam, open_above=True), plastic)
    for number in range(s.bands):
        # The bands represent the rims of stacked trays.
        top = s.feet + (number + 1) * (s.seam - LATCH - s.feet) / s.bands
        y = (front - BAND_OUT, s.depth / 2)
        band = box(-w - BAND_OUT, w + BAND_OUT, *y, top - BAND, top)
        body.boxes(f"band_{number}", {f"band_{number}": band}, steel)
    if s.post > 0:
        rows = corner_posts(w, (front, s.depth / 2), (s.feet, s.seam - POST_ROOM), s.post)
        body.boxes("posts", rows, RUBBER)
    base = stand(s.stand, w, (front, s.depth / 2), s.feet, FOOT_INSET, FOOT_HALF)
    if base:
        body.boxes("feet", base, RUBBER)
    body.boxes("catches", _latches(s, s.seam - LATCH, s.seam), steel)
    if s.bands:
        return
    body.print("label", "front", (x, front, z), (0.10, 0.0625), sticker)
    body.print("brand", "front", (0.03, front, z), (0.11, 0.024), brand)
    body.print("label_left", "left", (-w, 0.05, z), (0.09, 0.056), sticker)
    body.print("label_right", "right", (w, -0.05, z), (0.09, 0.056), sticker)


def _add_tools(body: LinkBuilder, s: SimpleNamespace, rng: np.random.Generator) -> None:
    """Add the content: a tray with three tools."""
    w, y0, y1, wall, z = s.width / 2, -s.depth / 2, s.depth / 2, s.wall, s.seam - 0.035
    felt = Material(texture_srgb=textures.make_speckles(rng, (0.52, 0.50, 0.46), 256), roughness=0.7)
    size = (2 * (w - wall), 0, 0), (0, y1 - y0 - 2 * wall, 0)
    body.meshes.append(panel("tray", (-w + wall, y0 + wall, z), *size, felt))
    half = 0.30 * s.width
    for number, share in enumerate((0.22, 0.5, 0.78)):
        y, x = y0 + share * (y1 - y0), rng.uniform(-0.05, 0.02)
        colored = Material(texture_srgb=textures.plastic(rng, pick_color(rng, "grip"), 64))
        end = x + half
        body.meshes.append(rod(f"grip_{number}", (x - half, y, z + 0.012), (x, y, z + 0.012), 0.012, colored))
        shaft = rod("shaft", (x, y, z + 0.010), (end, y, z + 0.010), 0.006, IRON)
        head = rod("head", (end, y - 0.02, z + 0.012), (end, y + 0.02, z + 0.012), 0.010, IRON)
        body.meshes.append(merge_meshes(f"iron_{number}", [shaft, head]))


def _add_toolbox_lid(
    lid: LinkBuilder, s: SimpleNamespace, color: Color, handle: Handle, rng: np.random.Generator
) -> None:
    plastic, steel = _tread_plate(rng, color, roughness=0.45), _steel(rng)
    rubber = Material(texture_srgb=textures.plastic(rng, (0.10, 0.10, 0.11), 128))
    lid.boxes("latches", _latches(s, s.low, s.low + 0.030), steel)
    flat, top = _add_top(lid, s, plastic)
    grip = CARRY_SHARE * s.width
    if s.carry:
        arch = [
            rod("arch", (-grip, 0, top + 0.03), (grip, 0, top + 0.03), 0.010, rubber),
            *(rod("post", (x, 0, top), (x, 0, top + 0.03), 0.008, rubber, 10) for x in (-grip, grip)),
        ]
        lid.meshes.append(merge_meshes("carry", arch))
        lid.solid("carry", box(-grip - 0.01, grip + 0.01, -0.01, 0.01, top, top + CARRY))
    _add_lid_prints(lid, flat, top, grip, color, rng)
    lid.handle(handle, steel)


def _add_top(lid: LinkBuilder, s: SimpleNamespace, plastic: Material) -> tuple[Span, float]:
    """Add walls and top of the lid; return the half sizes (x, y) and the height of its flat top, [m]."""
    w, d, top = s.width / 2, s.depth / 2, s.low + s.lid
    rows = _walls(s, s.low, s.eaves + s.wall if s.crown else top, open_above=False)
    if not s.crown:
        lid.boxes("lid", rows, plastic)
        flat = (w, d)
    else:
        del rows["plate"]
        lid.boxes("walls", rows, plastic)
        across = s.crown_share * d
        whole, radii = box(-w, w, -d, d, s.eaves, top), (across, s.crown - LEAST_CROWN)
        crown = RoundedBox(whole=whole, axis=0, radii=radii, corners=UPPER_EDGES, bevel=s.edge == "bevel")
        lid.add_rounded({"crown": crown}, plastic, name="lid")
        flat = (w, d - across)
    if s.tier > 0:
        flat = (flat[0] - TIER_INSET, flat[1] - TIER_INSET)
        lid.boxes(
            "tier", {"tier": box(-flat[0], flat[0], -flat[1], flat[1], top, top + s.tier, "z")}, plastic
        )
    return flat, top + s.tier


def _add_lid_prints(
    lid: LinkBuilder, flat: Span, top: float, grip: float, color: Color, rng: np.random.Generator
) -> None:
    """Add stickers and a nameplate on either side of the carrying handle, unless the flat top is too small for them."""
    w, d = flat
    art = Material(texture_srgb=textures.stickers(rng, color), roughness=0.5)
    brand = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.4)
    if d < 2 * PRINT_EDGE:
        return
    corner = (grip + 0.02, -d + PRINT_EDGE, top)
    lid.print("stickers", "top", corner, (w - grip - 0.02 - PRINT_EDGE, 2 * (d - PRINT_EDGE)), art)
    lid.print("name", "top", (-w + PRINT_EDGE, -0.02, top), (min(0.10, w - grip - 0.02), 0.035), brand)


def _walls(s: SimpleNamespace, z0: float, z1: float, *, open_above: bool) -> dict[str, AlignedBox]:
    """List the walls of a box that is open at the top or at the bottom: its plate and its four sides."""
    w, y0, y1, wall = s.width / 2, -s.depth / 2, s.depth / 2, s.wall
    low, high = (z0 + wall, z1) if open_above else (z0, z1 - wall)
    skip = "z" if open_above else "Z"
    return {
        "plate": box(-w, w, y0, y1, z0, low) if open_above else box(-w, w, y0, y1, high, z1),
        "left": box(-w, -w + wall, y0, y1, low, high, skip),
        "right": box(w - wall, w, y0, y1, low, high, skip),
        "front": box(-w + wall, w - wall, y0, y0 + wall, low, high, f"xX{skip}"),
        "back": box(-w + wall, w - wall, y1 - wall, y1, low, high, f"xX{skip}"),
    }


def _latches(s: SimpleNamespace, z0: float, z1: float) -> dict[str, AlignedBox]:
    """List the latches: plates on the front to the left and right of the handle."""
    x, front = 0.36 * s.width, -s.depth / 2
    return {
        f"latch_{name}": box(sign * x - 0.018, sign * x + 0.018, front - 0.009, front, z0, z1, "Y")
        for name, sign in (("left", -1.0), ("right", 1.0))
    }


def _tread_plate(
    rng: np.random.Generator, color: Color, *, roughness: float, metallic: float = 0.0
) -> Material:
    sheet = textures.tread_plate(rng, color)
    return Material(texture_srgb=sheet, tile_m=0.45, roughness=roughness, metallic=metallic)


def _steel(rng: np.random.Generator) -> Material:
    return Material(texture_srgb=textures.make_brushed_metal(rng, (0.70, 0.70, 0.72), 256), metallic=0.8)


def make_laptop(rng: np.random.Generator, table: Mapping[str, Any]) -> ArticulatedAsset:
    """Make a closed laptop that lies flat: a base with a notch at the front, and a lid that is held at its front edge.

    Args:
        rng: Generator of sizes, colors and prints.
        table: Rows of a style, see `builder.style_table`.
    """
    s = draw_sizes(rng, table)
    s.depth, s.seam = s.width * s.depth_share, STRIPS + s.base
    color = pick_color(rng, "laptop")
    base, lid = LinkBuilder("base"), LinkBuilder("lid")
    _add_base(base, s, color, rng)
    _add_laptop_lid(lid, s, color, rng)
    held = np.array([0.0, HELD - s.depth / 2, s.seam + SEAL + s.lid / 2])
    return assemble("laptop", base.link(s.body_mass), lid.link(s.lid_mass), _back_hinge(s), held)


def _add_base(base: LinkBuilder, s: SimpleNamespace, color: Color, rng: np.random.Generator) -> None:
    w, d, half = s.width / 2, s.depth / 2, s.notch_width / 2
    inner, z = s.notch_depth - d, (STRIPS, s.seam)
    # The front of a wedge-shaped base is thinner by `wedge`.
    front_z = (STRIPS + s.wedge, s.seam)
    slabs = {
        "base": box(-w, w, inner, d, *z),
        "front_left": box(-w, -half, -d, inner, *front_z, "Y"),
        "front_right": box(half, w, -d, inner, *front_z, "Y"),
    }
    case = _case(rng, color)
    if s.wedge > 0:
        body = RoundedBox(
            whole=slabs.pop("base"), axis=0, radii=(WEDGE_SHARE * s.depth, s.wedge), corners=((-1, -1),), bevel=True
        )  # fmt: skip
        base.add_rounded({"base": body}, case)
        base.boxes("front", slabs, case)
    elif s.corner > 0:
        base.add_rounded({key: _round(s, row) for key, row in slabs.items()}, case)
    else:
        base.boxes("base", slabs, case)
    _add_strips(base, s)
    _add_armour(base, s, case)
    front = inner + 0.003
    keys = Material(texture_srgb=textures.keyboard(rng, color), roughness=0.6)
    base.print("keys", "top", (-w + 0.006, front, s.seam), (2 * w - 0.012, d - 0.006 - front), keys)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        x, y, z_hinge = 0.66 * sign * w, d, s.seam + SEAL / 2
        ends = (x - 0.03, y, z_hinge), (x + 0.03, y, z_hinge)
        base.meshes.append(rod(f"hinge_{side}", *ends, 0.003, BLACK))


def _add_strips(base: LinkBuilder, s: SimpleNamespace) -> None:
    """Add the rubber strips below the base; the front strip of a wedge-shaped base is higher by `wedge`."""
    w, d = s.width / 2, s.depth / 2
    strips = {}
    for name, y in (("front", 0.03 - d), ("back", d - 0.02)):
        thinner = s.wedge if name == "front" else 0.0
        strips[f"foot_{name}"] = box(-0.8 * w, 0.8 * w, y - 0.004, y + 0.004, 0.0, STRIPS + thinner, "Z")
    base.boxes("feet", strips, BLACK)


def _add_armour(base: LinkBuilder, s: SimpleNamespace, case: Material) -> None:
    """Add protruding parts of the base: side pieces, a block behind the hinge, corner posts, a carrying handle."""
    w, d, z = s.width / 2, s.depth / 2, (STRIPS, s.seam - POST_ROOM)
    if s.tail > 0:
        half = TAIL_SHARE * w
        base.boxes("tail", {"tail": box(-half, half, d, d + s.tail, *z, "y")}, case)
    if s.wing > 0:
        sides = {"wing_left": box(-w - s.wing, -w, WING_INSET - d, d, *z, "X")}
        sides["wing_right"] = sides["wing_left"].mirror()
        base.boxes("wings", sides, BLACK)
    if s.post > 0:
        base.boxes("posts", corner_posts(w, (-d, d), z, s.post), RUBBER)
    if s.carry:
        # The arch is defined at the front; `behind` rotates it to the back.
        arch = ArchHandle(
            foot=np.array([0.0, -d, sum(z) / 2]), axis=LEVEL, length=w, thickness=0.014, clearance=0.03
        )
        base.behind("carry", arch, BLACK)


def _round(s: SimpleNamespace, row: AlignedBox) -> RoundedBox:
    """Round those vertical edges of a slab that are corners of the laptop as seen from above."""
    sides = (row.lower[0] == -s.width / 2, row.upper[0] == s.width / 2)
    ends = (row.lower[1] == -s.depth / 2, row.upper[1] == s.depth / 2)
    corners = tuple((2 * i - 1, 2 * j - 1) for i in (0, 1) for j in (0, 1) if sides[i] and ends[j])
    return RoundedBox(whole=row, axis=2, radii=(s.corner, s.corner), corners=corners)


def _add_laptop_lid(lid: LinkBuilder, s: SimpleNamespace, color: Color, rng: np.random.Generator) -> None:
    w, d, low = s.width / 2, s.depth / 2, s.seam + SEAL
    top = low + s.lid
    slab, rim = box(-w, w, RIM - d, d, low, top, "y"), box(-w, w, -d, RIM - d, low, top, "Y")
    case = _case(rng, color)
    display = Material(texture_srgb=textures.screen(rng), roughness=0.2)
    rows = {"lid": slab, "handle_rim": rim}
    if s.corner > 0:
        lid.add_rounded({key: _round(s, row) for key, row in rows.items()}, case)
    else:
        lid.boxes("lid", rows, case)
    if s.ridge > 0:
        half = RIDGE_SHARE * w
        lid.boxes("ridge", {"ridge": box(-half, half, 0.0, d - 0.01, top, top + s.ridge, "z")}, case)
    else:
        _add_cover_print(lid, (w, d), color, top, rng)
    # The display is upright for the user when the lid is open: its top is at the free edge. It is inset at round corners.
    cut = 0.3 * s.corner
    corner = (cut - w, d - cut, low - PRINT_GAP / 2)
    lid.meshes.append(panel("bezel", corner, (2 * (w - cut), 0, 0), (0, -2 * (d - cut), 0), BEZEL))
    edge = s.bezel + cut
    corner, size = (-w + edge, d - edge, low - PRINT_GAP), (2 * (w - edge), 2 * (d - edge))
    lid.meshes.append(panel("screen", corner, (size[0], 0, 0), (0, -size[1], 0), display))


def _add_cover_print(
    lid: LinkBuilder, half: Span, color: Color, top: float, rng: np.random.Generator
) -> None:
    """Add a nameplate, which is upright when the lid is open, or stickers that cover the lid."""
    if rng.random() < 0.5:
        name = Material(texture_srgb=textures.nameplate(rng, color, 64), roughness=0.4)
        lid.meshes.append(panel("name", (0.04, -0.01, top + PRINT_GAP), (-0.08, 0, 0), (0, -0.02, 0), name))
        return
    w, d = half[0] - 0.012, half[1] - 0.012
    art = Material(texture_srgb=textures.stickers(rng, color, count=int(rng.integers(2, 8))), roughness=0.5)
    lid.print("stickers", "top", (-w, -d, top), (2 * w, 2 * d), art)


def _case(rng: np.random.Generator, color: Color) -> Material:
    return Material(texture_srgb=textures.make_brushed_metal(rng, color), roughness=0.4, metallic=0.4)
