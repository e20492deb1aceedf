"""A parametric dresser: equal drawer fronts with equal thin bars, of which only one slides out."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.palette import DARKS, METALS, PAINTS, WOODS
from aomgen.assets.shapes import AlignedBox, Material, box, boxes_mesh, carcass, merge_meshes
from aomgen.assets.tray import tray_boxes
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint

# Free space between body, drawer and the fronts beside it, [m].
GAP = 0.003
# Boards between the drawers, [m].
SHELF = 0.008
# Columns and rows of fronts.
GRIDS = ((1, 2), (1, 3), (2, 1), (2, 2))
# A bar nearer to the table leaves no room for a gripper, [m].
LEAST_BAR_Z = 0.105
# Share of dressers that are dark all over, and of those whose fronts are of the body's wood.
DARK_SHARE, ONE_WOOD_SHARE = 0.4, 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class DresserShape:
    """Sizes of one dresser, [m], [kg].

    Attributes:
        columns, rows: Of fronts.
        pitch: Width and height of the space that one front has.
        depth: Of the body.
        feet, board: Height of the feet, thickness of boards and fronts.
        side: Thickness of the tray.
        travel: Of the drawer.
        bar_length, bar_thickness, bar_clearance: Of each handle.
        body_mass, drawer_mass: As they say.
    """

    columns: int
    rows: int
    pitch: tuple[float, float]
    depth: float
    feet: float
    board: float
    side: float
    travel: float
    bar_length: float
    bar_thickness: float
    bar_clearance: float
    body_mass: float
    drawer_mass: float

    @property
    def width(self) -> float:
        """Of the body."""
        return self.columns * self.pitch[0]

    @property
    def height(self) -> float:
        """Of the top."""
        return self.feet + self.rows * self.pitch[1]


def draw_shape(rng: np.random.Generator) -> DresserShape:
    """Random but realistic sizes."""
    columns, rows = GRIDS[rng.integers(len(GRIDS))]
    depth = rng.uniform(0.30, 0.36)
    width = rng.uniform(0.34, 0.42) if columns == 1 else rng.uniform(0.24, 0.28)
    return DresserShape(
        columns=columns,
        rows=rows,
        pitch=(width, rng.uniform(0.12, 0.14) if rows > 1 else rng.uniform(0.16, 0.20)),
        depth=depth,
        feet=rng.uniform(0.03, 0.05),
        board=rng.uniform(0.014, 0.018),
        side=rng.uniform(0.009, 0.012),
        travel=min(rng.uniform(0.20, 0.28), depth - 0.09),
        bar_length=rng.uniform(0.09, 0.15),
        bar_thickness=rng.uniform(0.006, 0.010),
        bar_clearance=rng.uniform(0.024, 0.032),
        body_mass=rng.uniform(9.0, 14.0),
        drawer_mass=rng.uniform(1.4, 2.2),
    )


def make_dresser(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One dresser; every size and color, and which drawer slides, come from `rng`."""
    shape = draw_shape(rng)
    cells = [(column, row) for column in range(shape.columns) for row in range(shape.rows)]
    reached = [cell for cell in cells if _handle(shape, cell).middle[2] > LEAST_BAR_Z]
    moving = reached[rng.integers(len(reached))]
    fixed = [cell for cell in cells if cell != moving]
    body, front, bar = _surfaces(rng)
    handle = _handle(shape, moving)
    return ArticulatedAsset(
        name=name,
        category="drawer",
        static=_body(shape, fixed, (body, front, bar)),
        moving=_drawer(shape, moving, (front, bar), rng),
        joint=Joint(
            type="prismatic",
            axis=np.array([0.0, -1.0, 0.0]),
            origin=handle.foot,
            lower=0.0,
            upper=shape.travel,
        ),
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _surfaces(rng: np.random.Generator) -> tuple[Material, Material, Material]:
    """Of the body, of all fronts and of all bars."""
    kind = rng.random()
    palette = DARKS if kind < DARK_SHARE else WOODS
    body = Material(texture_srgb=textures.wood(rng, palette[rng.integers(len(palette))]), roughness=0.55)
    front = body
    if kind > DARK_SHARE + ONE_WOOD_SHARE:
        front = Material(
            texture_srgb=textures.speckled(rng, PAINTS[rng.integers(len(PAINTS))]), roughness=0.5
        )
    metal = textures.brushed_metal(rng, METALS[rng.integers(len(METALS))], 256)
    return body, front, Material(texture_srgb=metal, metallic=0.8, roughness=0.3)


def _front(shape: DresserShape, cell: tuple[int, int]) -> AlignedBox:
    """The front of a cell; it covers the body's boards."""
    (width, height), back = shape.pitch, -shape.depth / 2 - GAP
    x, z = cell[0] * width - shape.width / 2, shape.feet + cell[1] * height
    margin = GAP / 2
    return box(x + margin, x + width - margin, back - shape.board, back, z + margin, z + height - margin)


def _handle(shape: DresserShape, cell: tuple[int, int]) -> BarHandle:
    face = _front(shape, cell)
    middle = (np.array(face.lower) + face.upper) / 2
    return BarHandle(
        foot=np.array([middle[0], face.lower[1], middle[2]]),
        axis=np.array([1.0, 0.0, 0.0]),
        length=shape.bar_length,
        thickness=shape.bar_thickness,
        clearance=shape.bar_clearance,
    )


def _body(
    shape: DresserShape, fixed: list[tuple[int, int]], surfaces: tuple[Material, Material, Material]
) -> AssetLink:
    w, y0, y1, board = shape.width / 2, -shape.depth / 2, shape.depth / 2, shape.board
    z0, z1 = shape.feet, shape.height
    inside = (z0 + board, z1 - board)
    boards = carcass(w, (y0, y1), (z0, z1), board)
    for row in range(1, shape.rows):
        z = z0 + row * shape.pitch[1]
        boards[f"shelf_{row}"] = box(
            -w + board, w - board, y0, y1 - board, z - SHELF / 2, z + SHELF / 2, "xXY"
        )
    if shape.columns == 2:
        boards["upright"] = box(-SHELF / 2, SHELF / 2, y0, y1 - board, *inside, "zZY")
    feet = {
        f"foot_{i}": box(x - 0.02, x + 0.02, y - 0.02, y + 0.02, 0.0, z0, "Z")
        for i, (x, y) in enumerate((x, y) for x in (-w + 0.05, w - 0.05) for y in (y0 + 0.05, y1 - 0.05))
    }
    fronts = {f"front_{column}_{row}": _front(shape, (column, row)) for column, row in fixed}
    handles = [_handle(shape, cell) for cell in fixed]
    body, front, bar = surfaces
    meshes = (
        boxes_mesh("boards", list(boards.values()), body),
        boxes_mesh("feet", list(feet.values()), Material(color_srgb=(0.10, 0.09, 0.08))),
        *(boxes_mesh(key, [face], front) for key, face in fronts.items()),
        merge_meshes("handles", [handle.mesh(bar) for handle in handles]),
    )
    colliders = [solid.collider(key) for key, solid in {**boards, **feet, **fronts}.items()]
    for key, handle in zip(fronts, handles, strict=True):
        colliders += handle.colliders(f"{key}_")
    return AssetLink(name="dresser", meshes=meshes, colliders=tuple(colliders), mass=shape.body_mass)


def _drawer(
    shape: DresserShape, cell: tuple[int, int], surfaces: tuple[Material, Material], rng: np.random.Generator
) -> AssetLink:
    face, handle = _front(shape, cell), _handle(shape, cell)
    (x0, _, z0), (x1, _, z1) = face.lower, face.upper
    room = shape.board + GAP
    start = -shape.depth / 2 - GAP
    tray = tray_boxes(
        (x0 + room, x1 - room),
        (start, shape.depth / 2 - shape.board - 0.01),
        (z0 + room, z1 - 0.035),
        shape.side,
    )
    ply = Material(texture_srgb=textures.wood(rng, (0.86, 0.77, 0.62), 256), roughness=0.6)
    front, bar = surfaces
    meshes = (
        boxes_mesh("front", [face], front),
        boxes_mesh("tray", list(tray.values()), ply),
        handle.mesh(bar),
    )
    colliders = tuple(solid.collider(key) for key, solid in {"front": face, **tray}.items())
    return AssetLink(
        name="drawer", meshes=meshes, colliders=(*colliders, *handle.colliders()), mass=shape.drawer_mass
    )
