"""A parametric drawer cabinet: hollow wooden body, one drawer that slides out, bar handle."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.palette import METALS, PAINTS, WOODS
from aomgen.assets.shapes import PRINT_GAP, Material, box, boxes_mesh, panel
from aomgen.assets.tray import tray_boxes
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint

# Free space between cabinet and drawer, [m].
GAP = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawerShape:
    """Sizes of one cabinet, [m], [kg]."""

    width: float
    height: float
    depth: float
    feet: float
    board: float
    drawer_height: float
    side: float
    travel: float
    handle_length: float
    handle_thickness: float
    handle_clearance: float
    body_mass: float
    drawer_mass: float


def draw_shape(rng: np.random.Generator) -> DrawerShape:
    """Random but realistic sizes."""
    height = rng.uniform(0.22, 0.32)
    depth = rng.uniform(0.34, 0.40)
    return DrawerShape(
        width=rng.uniform(0.36, 0.44),
        height=height,
        depth=depth,
        feet=rng.uniform(0.012, 0.025),
        board=rng.uniform(0.014, 0.018),
        drawer_height=rng.uniform(0.12, 0.15),
        side=rng.uniform(0.009, 0.012),
        travel=min(rng.uniform(0.22, 0.30), depth - 0.09),
        handle_length=rng.uniform(0.13, 0.18),
        handle_thickness=rng.uniform(0.011, 0.015),
        handle_clearance=rng.uniform(0.028, 0.034),
        body_mass=rng.uniform(9.0, 12.0),
        drawer_mass=rng.uniform(1.6, 2.4),
    )


def make_drawer(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One cabinet with one drawer; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    wood = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.55)
    if rng.random() < 0.5:
        front = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.5)
    else:
        front = Material(
            texture_srgb=textures.speckled(rng, PAINTS[rng.integers(len(PAINTS))]), roughness=0.5
        )
    handle = _handle(shape)
    joint = Joint(
        type="prismatic", axis=np.array([0.0, -1.0, 0.0]), origin=handle.foot, lower=0.0, upper=shape.travel
    )
    return ArticulatedAsset(
        name=name,
        category="drawer",
        static=_cabinet(shape, wood, rng),
        moving=_drawer(shape, front, handle, rng),
        joint=joint,
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _opening(shape: DrawerShape) -> tuple[float, float]:
    """Lower and upper end of the drawer's compartment, [m]."""
    top = shape.height - shape.board
    return top - shape.drawer_height, top


def _handle(shape: DrawerShape) -> BarHandle:
    low, top = _opening(shape)
    front = -shape.depth / 2 - GAP - shape.board
    return BarHandle(
        foot=np.array([0.0, front, (low + top) / 2]),
        axis=np.array([1.0, 0.0, 0.0]),
        length=shape.handle_length,
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )


def _cabinet(shape: DrawerShape, wood: Material, rng: np.random.Generator) -> AssetLink:
    w, y0, y1, board = shape.width / 2, -shape.depth / 2, shape.depth / 2, shape.board
    z0, z1 = shape.feet, shape.height
    low, _ = _opening(shape)
    boards = {
        "top": box(-w, w, y0, y1, z1 - board, z1),
        "bottom": box(-w, w, y0, y1, z0, z0 + board),
        "left": box(-w, -w + board, y0, y1, z0 + board, z1 - board, "zZ"),
        "right": box(w - board, w, y0, y1, z0 + board, z1 - board, "zZ"),
        "back": box(-w + board, w - board, y1 - board, y1, z0 + board, z1 - board, "xXzZ"),
    }
    if low - board > z0 + board + 0.02:
        # An open shelf is left below the drawer.
        boards["shelf"] = box(-w + board, w - board, y0, y1 - board, low - board, low, "xXY")
    feet = {
        f"foot_{i}": box(x - 0.02, x + 0.02, y - 0.02, y + 0.02, 0.0, z0, "Z")
        for i, (x, y) in enumerate((x, y) for x in (-w + 0.05, w - 0.05) for y in (y0 + 0.05, y1 - 0.05))
    }
    plate = Material(texture_srgb=textures.label(rng))
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, 0.02)
    meshes = (
        boxes_mesh("boards", list(boards.values()), wood),
        boxes_mesh("feet", list(feet.values()), Material(color_srgb=(0.10, 0.09, 0.08))),
        panel("label", (x, y, z1 + PRINT_GAP), (0.10, 0, 0), (0, 0.0625, 0), plate),
        panel("label_side", (w + PRINT_GAP, -0.03, z0 + 0.06), (0, 0.08, 0), (0, 0, 0.05), plate),
    )
    colliders = tuple(solid.collider(key) for key, solid in {**boards, **feet}.items())
    return AssetLink(name="cabinet", meshes=meshes, colliders=colliders, mass=shape.body_mass)


def _drawer(shape: DrawerShape, front: Material, handle: BarHandle, rng: np.random.Generator) -> AssetLink:
    w, y0, y1 = shape.width / 2, -shape.depth / 2, shape.depth / 2
    low, top = _opening(shape)
    face = box(-w + 0.002, w - 0.002, y0 - GAP - shape.board, y0 - GAP, low - 0.004, top + 0.008)
    inner = w - shape.board - GAP
    floor, rim = low + GAP, top - 0.03
    end, side = y1 - shape.board - 0.01, shape.side
    start = y0 - GAP
    tray = tray_boxes((-inner, inner), (start, end), (floor, rim), side)
    ply = Material(texture_srgb=textures.wood(rng, (0.86, 0.77, 0.62), 256), roughness=0.6)
    metal = METALS[rng.integers(len(METALS))]
    bar = Material(texture_srgb=textures.brushed_metal(rng, metal, 256), metallic=0.8, roughness=0.3)
    sign = Material(texture_srgb=textures.nameplate(rng, (0.93, 0.92, 0.88), 256, 64))
    corner = (-w + 0.02, face.lower[1] - PRINT_GAP, face.upper[2] - 0.034)
    meshes = (
        boxes_mesh("front", [face], front),
        boxes_mesh("tray", list(tray.values()), ply),
        panel("sign", corner, (0.06, 0, 0), (0, 0, 0.015), sign),
        handle.mesh(bar),
    )
    solids = {"front": face, **tray}
    colliders = tuple(solid.collider(key) for key, solid in solids.items())
    return AssetLink(
        name="drawer", meshes=meshes, colliders=(*colliders, *handle.colliders()), mass=shape.drawer_mass
    )
