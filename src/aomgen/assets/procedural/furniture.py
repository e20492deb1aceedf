"""Parametric furniture made of boards: single drawers, dressers with equal fronts, cabinets with a sliding panel."""

from collections.abc import Mapping
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np

from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import (
    LEVEL,
    UPRIGHT,
    Color,
    LinkBuilder,
    Span,
    assemble,
    carcass,
    draw_sizes,
    pick,
    pick_color,
    slide,
    stand,
)
from aomgen.assets.procedural.handles import OUTWARD, Handle, make_handle
from aomgen.assets.procedural.shapes import (
    ALL_EDGES,
    AlignedBox,
    Material,
    RoundedBox,
    box,
    merge_meshes,
    rod,
)
from aomgen.core.asset import ArticulatedAsset

# Gap between a body and a sliding part, [m].
GAP = 0.003
# Smallest height of a handle above the table at which it leaves enough clearance for a gripper, [m].
LEAST_BAR_Z = 0.105
# Share of drawers that are dark, and share of those whose fronts have the wood of the body.
DARK_SHARE, ONE_WOOD_SHARE = 0.4, 0.3
# Depth of an open drawer that remains in its body, [m].
KEPT_IN = 0.09
# Smallest height of an open shelf, and distance of the feet from the sides, [m].
LEAST_SHELF, FOOT_INSET = 0.02, 0.05
# Corner radius of a table top, [m].
TOP_RADIUS = 0.02
# Color of plywood, sRGB 0..1.
PLY = (0.86, 0.77, 0.62)
FELT = Material(color_srgb=(0.10, 0.09, 0.08))


def make_drawer(rng: np.random.Generator, table: Mapping[str, Any]) -> ArticulatedAsset:
    """Make a drawer or dresser: equal fronts with equal handles, one of which slides out.

    In the category `drawer`, the top front slides out, because neither images nor the instruction "open the drawer" distinguish
    equal fronts. Of a dresser, which tests reconstructions from prompts, any front may slide out. The body has an open shelf below
    the fronts if there is enough space.

    Args:
        rng: Generator of sizes, colors and prints.
        table: Rows of a style, see `builder.style_table`.

    Returns:
        The closed asset in the asset frame, with an empty name.
    """
    s = draw_sizes(rng, table)
    s.width, s.height = s.columns * s.pitch_x, max(s.height, s.feet + s.rows * s.pitch_z + s.reveal)
    s.low = s.height - s.reveal - s.rows * s.pitch_z
    faces = {cell: _drawer_front(s, cell) for cell in product(range(s.columns), range(s.rows))}
    handles = {cell: _drawer_handle(s, face) for cell, face in faces.items()}
    rows = [s.rows - 1] if s.opens == "top" else range(s.rows)
    moving = pick(rng, [cell for cell in faces if cell[1] in rows and handles[cell].middle[2] > LEAST_BAR_Z])
    wood, front, metal = _drawer_surfaces(rng)
    ply = Material(texture_srgb=textures.wood(rng, PLY, 256), roughness=0.6)

    body, drawer = LinkBuilder("cabinet"), LinkBuilder("drawer")
    body.boxes("boards", _drawer_boards(s), wood)
    _add_base_and_top(body, s, wood)
    fixed = {f"front_{column}_{row}": (column, row) for column, row in faces if (column, row) != moving}
    for key, cell in fixed.items():
        body.boxes(key, {key: faces[cell]}, front)
        body.colliders += handles[cell].colliders(f"{key}_")
    if fixed:
        body.meshes.append(merge_meshes("handles", [handles[cell].mesh(metal) for cell in fixed.values()]))
    else:
        _add_drawer_prints(body, drawer, s, faces[moving], rng)

    (x0, _, z0), (x1, start, z1) = faces[moving].lower, faces[moving].upper
    room, depth = s.board + GAP, (start, s.depth / 2 - s.board - 0.01)
    drawer.boxes("front", {"front": faces[moving]}, front)
    drawer.boxes("tray", tray((x0 + room, x1 - room), depth, (z0 + room, z1 - 0.035), s.side), ply)
    drawer.handle(handles[moving], metal)
    joint = slide(OUTWARD, handles[moving], min(s.travel, s.depth - KEPT_IN))
    return assemble("drawer", body.link(s.body_mass), drawer.link(s.part_mass), joint, handles[moving])


def _drawer_boards(s: SimpleNamespace) -> dict[str, AlignedBox]:
    """List the boards of the body and the thin boards between the drawers."""
    w, depth, board = s.width / 2, (-s.depth / 2, s.depth / 2), s.board
    boards = carcass(w, depth, (s.feet, s.height), board)
    across = (-w + board, w - board, depth[0], depth[1] - board)
    thin, inside = 0.008, (s.low + board, s.height - board)
    if s.low - s.feet > 2 * board + LEAST_SHELF:
        boards["shelf"] = box(*across, s.low, s.low + board, "xXY")
    for row in range(1, s.rows):
        z = s.low + row * s.pitch_z
        boards[f"shelf_{row}"] = box(*across, z - thin / 2, z + thin / 2, "xXY")
    for column in range(1, s.columns):
        x = column * s.pitch_x - w
        boards[f"upright_{column}"] = box(x - thin / 2, x + thin / 2, *across[2:], *inside, "zZY")
    return boards


def _add_base_and_top(body: LinkBuilder, s: SimpleNamespace, wood: Material) -> None:
    """Add the base of a piece of furniture, its table top with round corners and the board at the back of the top."""
    w, y0, y1 = s.width / 2, -s.depth / 2, s.depth / 2
    base = stand(s.stand, w, (y0, y1), s.feet, FOOT_INSET, s.foot_half)
    if base:
        body.boxes("feet", base, FELT if s.stand == "blocks" else wood, symmetric=True)
    s.top = s.height
    if s.overhang > 0:
        s.top += s.board
        front, edge = y0 - 2 * GAP - s.board - s.overhang, w + s.overhang
        whole = box(-edge, edge, front, y1, s.height, s.top)
        radii = (TOP_RADIUS, TOP_RADIUS)
        body.add_rounded({"table_top": RoundedBox(whole=whole, axis=2, radii=radii, corners=ALL_EDGES)}, wood)
    if s.upstand > 0:
        rows = {"upstand": box(-w, w, y1 - s.board, y1, s.top, s.top + s.upstand, "z")}
        body.boxes("upstand", rows, wood, symmetric=True)


def _add_drawer_prints(
    body: LinkBuilder, drawer: LinkBuilder, s: SimpleNamespace, face: AlignedBox, rng: np.random.Generator
) -> None:
    """Add rating plates on the top and the side, and a nameplate on the front."""
    plate = Material(texture_srgb=textures.label(rng))
    sign = Material(texture_srgb=textures.nameplate(rng, (0.93, 0.92, 0.88), 64))
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.02)
    body.print("label", "top", (x, y, s.top), (0.10, 0.0625), plate)
    body.print("label_side", "right", (s.width / 2, -0.03, s.low + 0.06), (0.08, 0.05), plate)
    drawer.print(
        "sign", "front", (face.lower[0] + 0.02, face.lower[1], face.upper[2] - 0.03), (0.06, 0.015), sign
    )


def _drawer_front(s: SimpleNamespace, cell: tuple[int, int]) -> AlignedBox:
    """Compute the front of the drawer in a cell (column, row); it covers the front edges of the boards."""
    back, margin = -s.depth / 2 - GAP, GAP / 2
    x, z = cell[0] * s.pitch_x - s.width / 2, s.low + cell[1] * s.pitch_z
    return box(x + margin, x + s.pitch_x - margin, back - s.board, back, z + margin, z + s.pitch_z - margin)


def _drawer_handle(s: SimpleNamespace, face: AlignedBox) -> Handle:
    middle = (np.array(face.lower) + face.upper) / 2
    return make_handle(s, np.array([middle[0], face.lower[1], middle[2]]), LEVEL, s.bar_length)


def _drawer_surfaces(rng: np.random.Generator) -> tuple[Material, Material, Material]:
    """Sample the materials of the body, of all fronts and of all handles."""
    kind = rng.random()
    body = _wood(rng, "dark" if kind < DARK_SHARE else "wood", 0.55)
    front = _paint(rng, pick_color(rng, "paint")) if kind > DARK_SHARE + ONE_WOOD_SHARE else body
    return body, front, _metal(rng)


def make_cabinet(rng: np.random.Generator, table: Mapping[str, Any]) -> ArticulatedAsset:
    """Make a cabinet with a fixed panel and a panel that slides sideways in front of open shelves.

    Args:
        rng: Generator of sizes, colors and prints.
        table: Rows of a style, see `builder.style_table`.

    Returns:
        The closed asset in the asset frame, with an empty name.
    """
    s = draw_sizes(rng, table)
    body, door = (LinkBuilder(name, mirrored=s.side < 0.5) for name in ("cabinet", "door"))
    w, front = s.width / 2, -s.depth / 2
    wood, paint = _wood(rng, "wood", 0.55), pick_color(rng, "paint")
    z = (s.feet + s.rail + GAP, s.height - s.rail - GAP)
    slab = box(-s.width / 2 + GAP, s.overlap, front - GAP - s.door, front - GAP, *z)
    middle = np.array([body.across(-s.width / 2 + 0.055), slab.lower[1], (z[0] + z[1]) / 2])
    handle = make_handle(s, middle, UPRIGHT, s.bar_share * (z[1] - z[0]))
    _add_cabinet_body(body, s, wood, paint, rng)
    _add_sliding_panel(door, s, slab, paint, handle, rng)
    joint = slide([body.across(1.0), 0.0, 0.0], handle, w - s.overlap - GAP)
    return assemble("cabinet", body.link(s.body_mass), door.link(s.part_mass), joint, handle)


def _add_cabinet_body(
    body: LinkBuilder, s: SimpleNamespace, wood: Material, paint: Color, rng: np.random.Generator
) -> None:
    w, y0, y1, z0, z1, board = s.width / 2, -s.depth / 2, s.depth / 2, s.feet, s.height, s.board
    lip, middle = y0 - 2 * GAP - s.door, (z0 + z1) / 2
    plate = Material(texture_srgb=textures.label(rng))
    art = Material(texture_srgb=textures.stickers(rng, paint, count=5), roughness=0.6)
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, -0.02)
    boards = {
        **carcass(w, (y0, y1), (z0, z1), board),
        "shelf": box(-w + board, w - board, y0 + 0.03, y1 - board, middle - 0.005, middle + 0.005, "xXY"),
        "rail_top": box(-w, w, lip, y0, z1 - s.rail, z1, "Y"),
        "rail_bottom": box(-w, w, lip, y0, z0, z0 + s.rail, "Y"),
    }
    panel = box(0.0, w - board, y0, y0 + 0.010, z0 + board, z1 - board, "XzZ")
    body.boxes("boards", boards, wood, symmetric=True)
    body.boxes("fixed_panel", {"fixed_panel": panel}, _paint(rng, paint))
    _add_base_and_top(body, s, wood)
    left, right = sorted((body.across(0.05), body.across(w - board - 0.02)))
    body.print("label", "top", (x, y, s.top), (0.10, 0.0625), plate)
    body.print("label_side", "right", (w, -0.03, z0 + 0.06), (0.08, 0.05), plate)
    body.print("fixed_print", "front", (left, y0, z0 + 0.06), (right - left, 0.7 * (right - left)), art)
    _add_cans(body, s, (z0 + board, middle + 0.005), rng)


def _add_cans(body: LinkBuilder, s: SimpleNamespace, levels: Span, rng: np.random.Generator) -> None:
    """Add cans on the floor and on the shelf behind the sliding panel."""
    for level, z in enumerate(levels):
        for place in range(3):
            x = body.across(-s.width / 2 + 0.07 + 0.075 * place + rng.uniform(-0.008, 0.008))
            y, height = rng.uniform(-0.03, 0.04), rng.uniform(0.06, 0.09)
            print_srgb = textures.stickers(rng, rng.uniform(0.15, 0.85, 3), 256, 128, 4)
            paper = Material(texture_srgb=print_srgb, tile_m=height)
            radius = rng.uniform(0.022, 0.03)
            body.meshes.append(rod(f"can_{level}_{place}", (x, y, z), (x, y, z + height), radius, paper, 18))


def _add_sliding_panel(
    door: LinkBuilder,
    s: SimpleNamespace,
    slab: AlignedBox,
    paint: Color,
    handle: Handle,
    rng: np.random.Generator,
) -> None:
    face = _wood(rng, "wood", 0.5) if rng.random() < 0.5 else _paint(rng, paint)
    metal = _metal(rng)
    art = textures.stickers(rng, face.texture_srgb.mean((0, 1)) / 255, 320, 320, 5)
    door.boxes("door", {"door": slab}, face)
    (x0, _, z0), (x1, _, z1) = slab.lower, slab.upper
    size = min(0.5 * (x1 - x0), 0.6 * (z1 - z0))
    # The print is on the half of the panel without the handle.
    left = -x1 + 0.015 if door.mirrored else x1 - 0.015 - size
    corner = (left, slab.lower[1], (z0 + z1 - size) / 2)
    door.print("print", "front", corner, (size, size), Material(texture_srgb=art, roughness=0.6))
    door.handle(handle, metal)


def tray(sides: Span, depth: Span, heights: Span, thin: float) -> dict[str, AlignedBox]:
    """List the boards of the open box behind a drawer's front: floor, two sides and back.

    Args:
        sides: Outer planes on the left and right (x), [m].
        depth: Rear face of the drawer's front and outer plane at the back (y), [m].
        heights: Lower face of the floor and rim (z), [m].
        thin: Thickness of all boards, [m].
    """
    (x0, x1), (start, end), (floor, rim) = sides, depth, heights
    return {
        "tray_bottom": box(x0, x1, start, end, floor, floor + thin, "y"),
        "tray_left": box(x0, x0 + thin, start, end, floor + thin, rim, "yz"),
        "tray_right": box(x1 - thin, x1, start, end, floor + thin, rim, "yz"),
        "tray_back": box(x0 + thin, x1 - thin, end - thin, end, floor + thin, rim, "xXz"),
    }


def _wood(rng: np.random.Generator, kind: str, roughness: float) -> Material:
    return Material(texture_srgb=textures.wood(rng, pick_color(rng, kind)), roughness=roughness)


def _paint(rng: np.random.Generator, color: Color) -> Material:
    return Material(texture_srgb=textures.make_speckles(rng, color), roughness=0.5)


def _metal(rng: np.random.Generator) -> Material:
    brushed = textures.make_brushed_metal(rng, pick_color(rng, "metal"), 256)
    return Material(texture_srgb=brushed, metallic=0.8, roughness=0.3)
