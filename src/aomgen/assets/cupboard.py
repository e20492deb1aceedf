"""A parametric cupboard with a drawer above a hinged door; the seed says which of the two is the moving part."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.assets import decals, textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.palette import METALS, PAINTS, WOODS
from aomgen.assets.shapes import PRINT_GAP, Material, box, boxes_mesh, carcass, merge_meshes, panel, rod
from aomgen.assets.tray import tray_boxes
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh

# Free space between cupboard, drawer and door, [m].
GAP = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class CupboardShape:
    """Sizes of one cupboard, [m], [rad], [kg]."""

    width: float
    height: float
    depth: float
    feet: float
    board: float
    front: float
    drawer_height: float
    travel: float
    opening: float
    bar_length: float
    bar_thickness: float
    bar_clearance: float
    body_mass: float
    part_mass: float
    hinge_right: bool
    door_moves: bool

    @property
    def shelf(self) -> float:
        """Upper side of the board between drawer and door."""
        return self.height - self.board - self.drawer_height

    @property
    def face(self) -> float:
        """Outer plane of both fronts, asset frame y."""
        return -self.depth / 2 - GAP - self.front


def draw_shape(rng: np.random.Generator) -> CupboardShape:
    """Random but realistic sizes."""
    depth = rng.uniform(0.30, 0.36)
    return CupboardShape(
        width=rng.uniform(0.34, 0.42),
        height=rng.uniform(0.36, 0.42),
        depth=depth,
        feet=rng.uniform(0.012, 0.025),
        board=rng.uniform(0.013, 0.017),
        front=rng.uniform(0.014, 0.018),
        drawer_height=rng.uniform(0.11, 0.13),
        travel=min(rng.uniform(0.20, 0.27), depth - 0.09),
        opening=np.deg2rad(rng.uniform(98, 110)),
        bar_length=rng.uniform(0.11, 0.14),
        bar_thickness=rng.uniform(0.011, 0.015),
        bar_clearance=rng.uniform(0.028, 0.034),
        body_mass=rng.uniform(9.0, 12.0),
        part_mass=rng.uniform(1.2, 1.8),
        hinge_right=bool(rng.random() < 0.5),
        door_moves=bool(rng.random() < 0.5),
    )


def make_cupboard(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One cupboard; what does not move, door or drawer, belongs to its static part."""
    shape = draw_shape(rng)
    wood = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.55)
    paint = PAINTS[rng.integers(len(PAINTS))]
    metal = METALS[rng.integers(len(METALS))]
    bar = Material(texture_srgb=textures.brushed_metal(rng, metal, 256), metallic=0.8, roughness=0.3)
    body = _body(shape, wood, rng)
    drawer, drawer_bar = _drawer(shape, paint, bar, rng)
    door, door_bar = _door(shape, paint, bar, rng)
    sliding = Joint(
        type="prismatic", axis=np.array([0.0, -1, 0]), origin=drawer_bar.foot, lower=0.0, upper=shape.travel
    )
    x = shape.width / 2 if shape.hinge_right else -shape.width / 2
    turning = Joint(
        type="revolute",
        axis=np.array([0.0, 0.0, 1.0 if shape.hinge_right else -1.0]),
        origin=np.array([x, shape.face + shape.front, shape.shelf / 2]),
        lower=0.0,
        upper=shape.opening,
    )
    moving, still = (door, drawer) if shape.door_moves else (drawer, door)
    handle = door_bar if shape.door_moves else drawer_bar
    return ArticulatedAsset(
        name=name,
        category="cupboard",
        static=_joined(body, still),
        moving=moving,
        joint=turning if shape.door_moves else sliding,
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _joined(body: AssetLink, part: AssetLink) -> AssetLink:
    """The body with a part that stays where it is; its names are told apart."""
    meshes = tuple(replace(mesh, name=f"{part.name}_{mesh.name}") for mesh in part.meshes)
    boxes = tuple(replace(item, name=f"{part.name}_{item.name}") for item in part.colliders)
    return replace(
        body,
        meshes=(*body.meshes, *meshes),
        colliders=(*body.colliders, *boxes),
        mass=body.mass + part.mass,
    )


def _body(shape: CupboardShape, wood: Material, rng: np.random.Generator) -> AssetLink:
    w, y0, y1, board = shape.width / 2, -shape.depth / 2, shape.depth / 2, shape.board
    z0, z1 = shape.feet, shape.height
    boards = {
        **carcass(w, (y0, y1), (z0, z1), board),
        "shelf": box(-w + board, w - board, y0, y1 - board, shape.shelf - board, shape.shelf, "xXY"),
    }
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
        panel("label_left", (-w - PRINT_GAP, 0.05, z0 + 0.09), (0, -0.08, 0), (0, 0, 0.05), plate),
        panel("label_right", (w + PRINT_GAP, -0.03, z0 + 0.12), (0, 0.08, 0), (0, 0, 0.05), plate),
        *_crockery(shape, rng),
    )
    colliders = tuple(solid.collider(key) for key, solid in {**boards, **feet}.items())
    return AssetLink(name="cupboard", meshes=meshes, colliders=colliders, mass=shape.body_mass)


def _crockery(shape: CupboardShape, rng: np.random.Generator) -> list[Mesh]:
    """Two piles of plates on the floor behind the door."""
    meshes = []
    for side in (-1.0, 1.0):
        glaze = Material(texture_srgb=textures.speckled(rng, rng.uniform(0.4, 0.9, 3), 128), roughness=0.3)
        x, z = side * 0.08, shape.feet + shape.board
        radius, count = rng.uniform(0.05, 0.065), int(rng.integers(3, 7))
        pile = [
            rod(
                "plate",
                (x, 0.02, z + 0.011 * i),
                (x, 0.02, z + 0.011 * i + 0.008),
                radius * (1.0 - 0.06 * (i % 2)),
                glaze,
                22,
            )
            for i in range(count)
        ]
        meshes.append(merge_meshes(f"plates_{'left' if side < 0 else 'right'}", pile))
    return meshes


def _bar(shape: CupboardShape, x: float, z: float, axis: tuple[float, float, float]) -> BarHandle:
    return BarHandle(
        foot=np.array([x, shape.face, z]),
        axis=np.array(axis),
        length=shape.bar_length,
        thickness=shape.bar_thickness,
        clearance=shape.bar_clearance,
    )


def _drawer(
    shape: CupboardShape, paint: tuple[float, float, float], bar: Material, rng: np.random.Generator
) -> tuple[AssetLink, BarHandle]:
    w, start, end = shape.width / 2, -shape.depth / 2 - GAP, shape.depth / 2 - shape.board - 0.01
    low, top, thin = shape.shelf, shape.height - shape.board, 0.010
    face = box(-w + 0.002, w - 0.002, shape.face, start, low - 0.004, top + 0.008)
    inner, floor, rim = w - shape.board - GAP, low + GAP, top - 0.025
    tray = tray_boxes((-inner, inner), (start, end), (floor, rim), thin)
    handle = _bar(shape, 0.0, (low + top) / 2, (1.0, 0.0, 0.0))
    ply = Material(texture_srgb=textures.wood(rng, (0.86, 0.77, 0.62), 256), roughness=0.6)
    sheet = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.5)
    sign = Material(texture_srgb=textures.nameplate(rng, paint, 256, 64))
    meshes = (
        boxes_mesh("front", [face], sheet),
        boxes_mesh("tray", list(tray.values()), ply),
        panel("sign", (-w + 0.02, shape.face - PRINT_GAP, top - 0.03), (0.07, 0, 0), (0, 0, 0.0175), sign),
        handle.mesh(bar),
    )
    colliders = tuple(solid.collider(key) for key, solid in {"front": face, **tray}.items())
    link = AssetLink(
        name="drawer", meshes=meshes, colliders=(*colliders, *handle.colliders()), mass=shape.part_mass
    )
    return link, handle


def _door(
    shape: CupboardShape, paint: tuple[float, float, float], bar: Material, rng: np.random.Generator
) -> tuple[AssetLink, BarHandle]:
    w, back = shape.width / 2, -shape.depth / 2 - GAP
    # A finger's breadth below the drawer's front, so that neither rubs the other.
    low, top = shape.feet, shape.shelf - 0.004 - GAP
    slab = box(-w + 0.002, w - 0.002, shape.face, back, low, top)
    free = -1.0 if shape.hinge_right else 1.0
    handle = _bar(shape, free * (w - 0.04), (low + top) / 2, (0.0, 0.0, 1.0))
    sheet = Material(texture_srgb=textures.speckled(rng, paint), roughness=0.5)
    art = Material(texture_srgb=decals.stickers(rng, paint, 320, 320, 5), roughness=0.6)
    size = 0.55 * min(2 * w, top - low)
    corner = (-free * 0.3 * w - size / 2, shape.face - PRINT_GAP, (low + top - size) / 2)
    meshes = (
        boxes_mesh("door", [slab], sheet),
        panel("print", corner, (size, 0, 0), (0, 0, size), art),
        handle.mesh(bar),
    )
    link = AssetLink(
        name="door",
        meshes=meshes,
        colliders=(slab.collider("door"), *handle.colliders()),
        mass=shape.part_mass,
    )
    return link, handle
