"""A parametric sliding-door cabinet: hollow body, one fixed and one sliding panel, upright bar handle."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import decals, textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.palette import METALS, PAINTS, WOODS
from aomgen.assets.shapes import PRINT_GAP, AlignedBox, Material, box, boxes_mesh, carcass, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.joint import Joint
from aomgen.core.mesh import Mesh

# Free space around the sliding panel, [m].
GAP = 0.003


@dataclass(frozen=True, slots=True, kw_only=True)
class CabinetShape:
    """Sizes of one cabinet, [m], [kg], drawn with the sliding panel on the left (-x)."""

    width: float
    height: float
    depth: float
    feet: float
    board: float
    rail: float
    door: float
    overlap: float
    handle_share: float
    handle_thickness: float
    handle_clearance: float
    body_mass: float
    door_mass: float
    slides_left: bool

    @property
    def front(self) -> float:
        """Plane of the body's boards in front, asset frame y."""
        return -self.depth / 2

    @property
    def travel(self) -> float:
        """How far the panel slides until it meets the other end."""
        return self.width / 2 - self.overlap - GAP


def draw_shape(rng: np.random.Generator) -> CabinetShape:
    """Random but realistic sizes."""
    return CabinetShape(
        width=rng.uniform(0.50, 0.62),
        height=rng.uniform(0.27, 0.35),
        depth=rng.uniform(0.24, 0.30),
        feet=rng.uniform(0.015, 0.030),
        board=rng.uniform(0.013, 0.017),
        rail=rng.uniform(0.018, 0.024),
        door=rng.uniform(0.012, 0.016),
        overlap=rng.uniform(0.015, 0.030),
        handle_share=rng.uniform(0.45, 0.62),
        handle_thickness=rng.uniform(0.011, 0.015),
        handle_clearance=rng.uniform(0.028, 0.034),
        body_mass=rng.uniform(9.0, 12.0),
        door_mass=rng.uniform(0.9, 1.5),
        slides_left=bool(rng.random() < 0.5),
    )


def make_cabinet(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One cabinet whose left or right panel slides sideways; all comes from `rng`."""
    shape = draw_shape(rng)
    wood = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.55)
    paint = PAINTS[rng.integers(len(PAINTS))]
    handle = _handle(shape)
    joint = Joint(
        type="prismatic",
        axis=np.array([_sided(shape, 1.0), 0.0, 0.0]),
        origin=handle.foot,
        lower=0.0,
        upper=shape.travel,
    )
    return ArticulatedAsset(
        name=name,
        category="cabinet",
        static=_body(shape, wood, paint, rng),
        moving=_door(shape, paint, handle, rng),
        joint=joint,
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _sided(shape: CabinetShape, x: float) -> float:
    return -x if shape.slides_left else x


def _side_box(
    shape: CabinetShape,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    skip: str = "",
) -> AlignedBox:
    """A box drawn for a panel on the left, mirrored where it is on the right."""
    low, high = sorted((_sided(shape, x[0]), _sided(shape, x[1])))
    if shape.slides_left:
        skip = skip.translate(str.maketrans("xX", "Xx"))
    return box(low, high, *y, *z, skip)


def _door_box(shape: CabinetShape) -> AlignedBox:
    back = shape.front - GAP
    z = (shape.feet + shape.rail + GAP, shape.height - shape.rail - GAP)
    return _side_box(shape, (-shape.width / 2 + GAP, shape.overlap), (back - shape.door, back), z)


def _handle(shape: CabinetShape) -> BarHandle:
    door = _door_box(shape)
    height = door.upper[2] - door.lower[2]
    return BarHandle(
        foot=np.array(
            [_sided(shape, -shape.width / 2 + 0.055), door.lower[1], (door.lower[2] + door.upper[2]) / 2]
        ),
        axis=np.array([0.0, 0.0, 1.0]),
        length=shape.handle_share * height,
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )


def _body(
    shape: CabinetShape, wood: Material, paint: tuple[float, float, float], rng: np.random.Generator
) -> AssetLink:
    w, y0, y1, board = shape.width / 2, shape.front, shape.depth / 2, shape.board
    z0, z1 = shape.feet, shape.height
    lip = y0 - 2 * GAP - shape.door
    inside = (z0 + board, z1 - board)
    boards = {
        **carcass(w, (y0, y1), (z0, z1), board),
        "shelf": box(-w + board, w - board, y0 + 0.03, y1 - board, *_shelf(shape), "xXY"),
        "rail_top": box(-w, w, lip, y0, z1 - shape.rail, z1, "Y"),
        "rail_bottom": box(-w, w, lip, y0, z0, z0 + shape.rail, "Y"),
    }
    fixed = _side_box(shape, (0.0, w - board), (y0, y0 + 0.010), inside, "XzZ")
    feet = {
        f"foot_{i}": box(x - 0.02, x + 0.02, y - 0.02, y + 0.02, 0.0, z0, "Z")
        for i, (x, y) in enumerate((x, y) for x in (-w + 0.05, w - 0.05) for y in (y0 + 0.05, y1 - 0.05))
    }
    plate = Material(texture_srgb=textures.label(rng))
    left, right = sorted((_sided(shape, 0.05), _sided(shape, w - board - 0.02)))
    art = Material(texture_srgb=decals.stickers(rng, paint, count=5), roughness=0.6)
    x, y = rng.uniform(-0.12, 0.02), rng.uniform(-0.10, -0.02)
    meshes = (
        boxes_mesh("boards", list(boards.values()), wood),
        boxes_mesh(
            "fixed_panel", [fixed], Material(texture_srgb=textures.speckled(rng, paint), roughness=0.5)
        ),
        boxes_mesh("feet", list(feet.values()), Material(color_srgb=(0.10, 0.09, 0.08))),
        panel("label", (x, y, z1 + PRINT_GAP), (0.10, 0, 0), (0, 0.0625, 0), plate),
        panel("label_side", (w + PRINT_GAP, -0.03, z0 + 0.06), (0, 0.08, 0), (0, 0, 0.05), plate),
        panel(
            "fixed_print",
            (left, y0 - PRINT_GAP, z0 + 0.06),
            (right - left, 0, 0),
            (0, 0, 0.7 * (right - left)),
            art,
        ),
        *_goods(shape, rng),
    )
    solids = {**boards, "fixed_panel": fixed, **feet}
    colliders = tuple(solid.collider(key) for key, solid in solids.items())
    return AssetLink(name="cabinet", meshes=meshes, colliders=colliders, mass=shape.body_mass)


def _shelf(shape: CabinetShape) -> tuple[float, float]:
    middle = (shape.feet + shape.height) / 2
    return middle - 0.005, middle + 0.005


def _goods(shape: CabinetShape, rng: np.random.Generator) -> list[Mesh]:
    """Jars and cans on the floor and on the shelf behind the sliding panel."""
    meshes = []
    for level, z in enumerate((shape.feet + shape.board, _shelf(shape)[1])):
        for place in range(3):
            x = _sided(shape, -shape.width / 2 + 0.07 + 0.075 * place + rng.uniform(-0.008, 0.008))
            y, height = rng.uniform(-0.03, 0.04), rng.uniform(0.06, 0.09)
            color = rng.uniform(0.15, 0.85, 3)
            paper = Material(texture_srgb=decals.stickers(rng, color, 256, 128, 4), tile_m=height)
            meshes.append(
                rod(
                    f"can_{level}_{place}", (x, y, z), (x, y, z + height), rng.uniform(0.022, 0.03), paper, 18
                )
            )
    return meshes


def _door(
    shape: CabinetShape, paint: tuple[float, float, float], handle: BarHandle, rng: np.random.Generator
) -> AssetLink:
    slab = _door_box(shape)
    if rng.random() < 0.5:
        face = Material(texture_srgb=textures.wood(rng, WOODS[rng.integers(len(WOODS))]), roughness=0.5)
    else:
        face = Material(texture_srgb=textures.speckled(rng, paint), roughness=0.5)
    metal = METALS[rng.integers(len(METALS))]
    bar = Material(texture_srgb=textures.brushed_metal(rng, metal, 256), metallic=0.8, roughness=0.3)
    ground = tuple(np.asarray(face.texture_srgb.mean((0, 1)) / 255))
    art = Material(texture_srgb=decals.stickers(rng, ground, 320, 320, 5), roughness=0.6)
    (x0, front, z0), (x1, _, z1) = slab.lower, slab.upper
    size = min(0.5 * (x1 - x0), 0.6 * (z1 - z0))
    # The print stands on the half of the panel without the handle.
    left = x0 + 0.015 if shape.slides_left else x1 - 0.015 - size
    corner = (left, front - PRINT_GAP, (z0 + z1 - size) / 2)
    meshes = (
        boxes_mesh("door", [slab], face),
        panel("print", corner, (size, 0, 0), (0, 0, size), art),
        handle.mesh(bar),
    )
    return AssetLink(
        name="door",
        meshes=meshes,
        colliders=(slab.collider("door"), *handle.colliders()),
        mass=shape.door_mass,
    )
