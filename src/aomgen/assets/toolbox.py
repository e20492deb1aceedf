"""A parametric toolbox: hollow body with a tray of tools, lid hinged at the back, bar handle in front."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import decals, textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.lid import SEAL, back_hinge
from aomgen.assets.shapes import PRINT_GAP, AlignedBox, Material, box, boxes_mesh, merge_meshes, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.mesh import Mesh

# Colors of plastic boxes and their brighter lids, sRGB 0..1; the maker's taste.
BODIES = ((0.16, 0.17, 0.18), (0.30, 0.31, 0.33), (0.12, 0.16, 0.24), (0.24, 0.20, 0.17))
# Red, yellow, blue, green, orange.
LIDS = ((0.72, 0.13, 0.10), (0.86, 0.62, 0.10), (0.12, 0.32, 0.60), (0.20, 0.46, 0.26), (0.80, 0.38, 0.10))


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolboxShape:
    """Sizes of one toolbox, [m], [rad], [kg]."""

    width: float
    depth: float
    seam: float
    lid_height: float
    wall: float
    handle_length: float
    handle_thickness: float
    handle_clearance: float
    opening: float
    body_mass: float
    lid_mass: float

    @property
    def top(self) -> float:
        """Height of the closed box without its carrying handle."""
        return self.seam + SEAL + self.lid_height


def draw_shape(rng: np.random.Generator) -> ToolboxShape:
    """Random but realistic sizes."""
    return ToolboxShape(
        width=rng.uniform(0.36, 0.46),
        depth=rng.uniform(0.19, 0.24),
        seam=rng.uniform(0.11, 0.15),
        lid_height=rng.uniform(0.055, 0.080),
        wall=rng.uniform(0.006, 0.010),
        handle_length=rng.uniform(0.12, 0.16),
        handle_thickness=rng.uniform(0.011, 0.015),
        handle_clearance=rng.uniform(0.028, 0.034),
        opening=np.deg2rad(rng.uniform(100, 108)),
        body_mass=rng.uniform(4.0, 7.0),
        lid_mass=rng.uniform(0.5, 0.9),
    )


def make_toolbox(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One toolbox; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    body_color, lid_color = BODIES[rng.integers(len(BODIES))], LIDS[rng.integers(len(LIDS))]
    front = -shape.depth / 2
    handle = BarHandle(
        foot=np.array([0.0, front, shape.seam + SEAL + shape.lid_height / 2]),
        axis=np.array([1.0, 0.0, 0.0]),
        length=shape.handle_length,
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )
    return ArticulatedAsset(
        name=name,
        category="toolbox",
        static=_body(shape, body_color, lid_color, rng),
        moving=_lid(shape, lid_color, handle, rng),
        joint=back_hinge(shape.depth, shape.seam, shape.opening),
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _walls(shape: ToolboxShape, z0: float, z1: float, closed_below: bool) -> dict[str, AlignedBox]:
    """A box open above (or below): its four sides and its bottom (or top)."""
    w, y0, y1, wall = shape.width / 2, -shape.depth / 2, shape.depth / 2, shape.wall
    low, high = (z0 + wall, z1) if closed_below else (z0, z1 - wall)
    skip = "z" if closed_below else "Z"
    plate = box(-w, w, y0, y1, z0, low) if closed_below else box(-w, w, y0, y1, high, z1)
    return {
        "plate": plate,
        "left": box(-w, -w + wall, y0, y1, low, high, skip),
        "right": box(w - wall, w, y0, y1, low, high, skip),
        "front": box(-w + wall, w - wall, y0, y0 + wall, low, high, f"xX{skip}"),
        "back": box(-w + wall, w - wall, y1 - wall, y1, low, high, f"xX{skip}"),
    }


def _latches(shape: ToolboxShape, z0: float, z1: float) -> dict[str, AlignedBox]:
    """Plates on the front, left and right of the handle."""
    x, front = 0.36 * shape.width, -shape.depth / 2
    return {
        f"latch_{name}": box(sign * x - 0.018, sign * x + 0.018, front - 0.009, front, z0, z1, "Y")
        for name, sign in (("left", -1.0), ("right", 1.0))
    }


def _body(
    shape: ToolboxShape,
    color: tuple[float, float, float],
    lid_color: tuple[float, float, float],
    rng: np.random.Generator,
) -> AssetLink:
    w, y0, y1 = shape.width / 2, -shape.depth / 2, shape.depth / 2
    walls = _walls(shape, 0.0, shape.seam, closed_below=True)
    latches = _latches(shape, shape.seam - 0.034, shape.seam)
    sheet = Material(texture_srgb=decals.tread_plate(rng, color), tile_m=0.45, roughness=0.5, metallic=0.2)
    steel = Material(texture_srgb=textures.brushed_metal(rng, (0.70, 0.70, 0.72), 256), metallic=0.8)
    sticker = Material(texture_srgb=textures.label(rng), roughness=0.5)
    brand = Material(texture_srgb=textures.nameplate(rng, lid_color), roughness=0.4)
    x, z = rng.uniform(-0.13, -0.10), rng.uniform(0.012, 0.022)
    meshes = (
        boxes_mesh("body", list(walls.values()), sheet),
        boxes_mesh("catches", list(latches.values()), steel),
        panel("label", (x, y0 - PRINT_GAP, z), (0.10, 0, 0), (0, 0, 0.0625), sticker),
        panel("brand", (0.03, y0 - PRINT_GAP, z), (0.11, 0, 0), (0, 0, 0.024), brand),
        panel("label_left", (-w - PRINT_GAP, 0.05, z), (0, -0.09, 0), (0, 0, 0.056), sticker),
        panel("label_right", (w + PRINT_GAP, -0.05, z), (0, 0.09, 0), (0, 0, 0.056), sticker),
        *_tray(shape, y0, y1, rng),
    )
    colliders = tuple(solid.collider(key) for key, solid in {**walls, **latches}.items())
    return AssetLink(name="body", meshes=meshes, colliders=colliders, mass=shape.body_mass)


def _tray(shape: ToolboxShape, y0: float, y1: float, rng: np.random.Generator) -> list[Mesh]:
    """What lies inside: a tray with a screwdriver, a hammer and a wrench."""
    w, wall = shape.width / 2, shape.wall
    z = shape.seam - 0.035
    floor = Material(texture_srgb=textures.speckled(rng, (0.52, 0.50, 0.46), 256), roughness=0.7)
    low, size = (-w + wall, y0 + wall, z), (2 * (w - wall), y1 - y0 - 2 * wall)
    meshes = [panel("tray", low, (size[0], 0, 0), (0, size[1], 0), floor)]
    grips = [(0.80, 0.30, 0.08), (0.10, 0.42, 0.70), (0.85, 0.70, 0.10)]
    iron = Material(color_srgb=(0.62, 0.63, 0.66), metallic=0.8, roughness=0.35)
    for number, share in enumerate((0.22, 0.5, 0.78)):
        y, x = y0 + share * (y1 - y0), rng.uniform(-0.05, 0.02)
        colored = Material(texture_srgb=textures.plastic(rng, grips[rng.integers(3)], 64))
        half = 0.30 * shape.width
        meshes.append(rod(f"grip_{number}", (x - half, y, z + 0.012), (x, y, z + 0.012), 0.012, colored))
        shaft = rod("shaft", (x, y, z + 0.010), (x + half, y, z + 0.010), 0.006, iron)
        head = rod("head", (x + half, y - 0.02, z + 0.012), (x + half, y + 0.02, z + 0.012), 0.010, iron)
        meshes.append(merge_meshes(f"iron_{number}", [shaft, head]))
    return meshes


def _lid(
    shape: ToolboxShape, color: tuple[float, float, float], handle: BarHandle, rng: np.random.Generator
) -> AssetLink:
    w, y0, low, top = shape.width / 2, -shape.depth / 2, shape.seam + SEAL, shape.top
    walls = _walls(shape, low, top, closed_below=False)
    latches = _latches(shape, low, low + 0.030)
    sheet = Material(texture_srgb=decals.tread_plate(rng, color), tile_m=0.45, roughness=0.45)
    steel = Material(texture_srgb=textures.brushed_metal(rng, (0.70, 0.70, 0.72), 256), metallic=0.8)
    rubber = Material(texture_srgb=textures.plastic(rng, (0.10, 0.10, 0.11), 128))
    sheet_of_stickers = Material(texture_srgb=decals.stickers(rng, color), roughness=0.5)
    brand = Material(texture_srgb=textures.nameplate(rng, color), roughness=0.4)
    grip = 0.16 * shape.width
    arch = [
        rod("arch", (-grip, 0, top + 0.03), (grip, 0, top + 0.03), 0.010, rubber),
        rod("post", (-grip, 0, top), (-grip, 0, top + 0.03), 0.008, rubber, 10),
        rod("post", (grip, 0, top), (grip, 0, top + 0.03), 0.008, rubber, 10),
    ]
    inset = 0.03
    span = (w - grip - 0.02 - inset, shape.depth - 2 * inset)
    meshes = (
        boxes_mesh("lid", list(walls.values()), sheet),
        boxes_mesh("latches", list(latches.values()), steel),
        merge_meshes("carry", arch),
        panel(
            "stickers",
            (grip + 0.02, y0 + inset, top + PRINT_GAP),
            (span[0], 0, 0),
            (0, span[1], 0),
            sheet_of_stickers,
        ),
        panel("name", (-w + inset, -0.02, top + PRINT_GAP), (0.10, 0, 0), (0, 0.035, 0), brand),
        handle.mesh(steel),
    )
    carry = box(-grip - 0.01, grip + 0.01, -0.01, 0.01, top, top + 0.04)
    colliders = tuple(solid.collider(key) for key, solid in {**walls, **latches, "carry": carry}.items())
    return AssetLink(
        name="lid", meshes=meshes, colliders=(*colliders, *handle.colliders()), mass=shape.lid_mass
    )
