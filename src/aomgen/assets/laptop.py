"""A parametric laptop on a riser: base with a keyboard, lid with a screen, a small bar to lift it by."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import printed, textures
from aomgen.assets.handle import BarHandle
from aomgen.assets.lid import SEAL, back_hinge
from aomgen.assets.shapes import Surface, box, boxes_mesh, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink

PRINT = 0.0006
CASES = ((0.66, 0.67, 0.69), (0.20, 0.21, 0.23), (0.34, 0.40, 0.48), (0.72, 0.62, 0.54))
STANDS = ((0.60, 0.60, 0.62), (0.15, 0.15, 0.16), (0.76, 0.62, 0.44))


@dataclass(frozen=True, slots=True, kw_only=True)
class LaptopShape:
    """Sizes of one laptop and its riser, [m], [rad], [kg]."""

    width: float
    depth: float
    stand: float
    base: float
    lid: float
    bezel: float
    handle_length: float
    handle_thickness: float
    handle_clearance: float
    opening: float
    base_mass: float
    lid_mass: float

    @property
    def seam(self) -> float:
        """Height of the base's upper side."""
        return self.stand + self.base


def draw_shape(rng: np.random.Generator) -> LaptopShape:
    """Random but realistic sizes; the riser leaves room for fingers below the bar."""
    width = rng.uniform(0.32, 0.38)
    return LaptopShape(
        width=width,
        depth=width * rng.uniform(0.66, 0.72),
        stand=rng.uniform(0.10, 0.14),
        base=rng.uniform(0.017, 0.023),
        lid=rng.uniform(0.009, 0.013),
        bezel=rng.uniform(0.010, 0.016),
        handle_length=rng.uniform(0.09, 0.12),
        handle_thickness=rng.uniform(0.009, 0.012),
        handle_clearance=rng.uniform(0.028, 0.034),
        opening=np.deg2rad(rng.uniform(105, 125)),
        base_mass=rng.uniform(2.5, 3.5),
        lid_mass=rng.uniform(0.5, 0.8),
    )


def make_laptop(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One closed laptop on its riser; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    color = CASES[rng.integers(len(CASES))]
    handle = BarHandle(
        foot=np.array([0.0, -shape.depth / 2, shape.seam + SEAL + shape.lid / 2]),
        axis=np.array([1.0, 0.0, 0.0]),
        length=shape.handle_length,
        thickness=shape.handle_thickness,
        clearance=shape.handle_clearance,
    )
    return ArticulatedAsset(
        name=name,
        category="laptop",
        static=_base(shape, color, rng),
        moving=_lid(shape, color, handle, rng),
        joint=back_hinge(shape.depth, shape.seam, shape.opening),
        handle_point=handle.middle,
        handle_axis=handle.axis,
    )


def _base(shape: LaptopShape, color: tuple[float, float, float], rng: np.random.Generator) -> AssetLink:
    w, d, top = shape.width / 2, shape.depth / 2, shape.seam
    slab = box(-w, w, -d, d, shape.stand, top)
    x, front, back, sheet = 0.80 * w, -0.62 * d, 0.86 * d, 0.006
    riser = {
        "foot": box(-x, x, front, back, 0.0, sheet),
        "left": box(-x, -x + 0.010, front, back, sheet, shape.stand - sheet, "zZ"),
        "right": box(x - 0.010, x, front, back, sheet, shape.stand - sheet, "zZ"),
        "shelf": box(-0.94 * w, 0.94 * w, front, back, shape.stand - sheet, shape.stand),
    }
    case = Surface(texture_srgb=textures.brushed_metal(rng, color, 512), roughness=0.4, metallic=0.4)
    stand_color = STANDS[rng.integers(len(STANDS))]
    wooden = stand_color[0] > stand_color[2] + 0.1
    stand = (textures.wood if wooden else textures.speckled)(rng, stand_color)
    keys = Surface(texture_srgb=printed.keyboard(rng, color), roughness=0.6)
    sticker = Surface(texture_srgb=textures.label(rng), roughness=0.6)
    black = Surface(color_srgb=(0.06, 0.06, 0.07))
    size = (2 * w - 0.012, 2 * d - 0.012)
    z = 0.5 * shape.stand - 0.02
    hinge = (d, top + SEAL / 2)
    meshes = (
        boxes_mesh("base", [slab], case),
        boxes_mesh("riser", list(riser.values()), Surface(texture_srgb=stand, tile_m=0.4, roughness=0.5)),
        panel("keys", (-w + 0.006, -d + 0.006, top + PRINT), (size[0], 0, 0), (0, size[1], 0), keys),
        panel("label_left", (-x - PRINT, 0.035, z), (0, -0.07, 0), (0, 0, 0.044), sticker),
        panel("label_right", (x + PRINT, -0.035, z), (0, 0.07, 0), (0, 0, 0.044), sticker),
        *(
            rod(
                f"hinge_{side}",
                (0.66 * sign * w - 0.03, *hinge),
                (0.66 * sign * w + 0.03, *hinge),
                0.005,
                black,
            )
            for side, sign in (("left", -1.0), ("right", 1.0))
        ),
    )
    solids = {"base": slab, **riser}
    colliders = tuple(solid.collider(key) for key, solid in solids.items())
    return AssetLink(name="base", meshes=meshes, colliders=colliders, mass=shape.base_mass)


def _lid(
    shape: LaptopShape, color: tuple[float, float, float], handle: BarHandle, rng: np.random.Generator
) -> AssetLink:
    w, d, low = shape.width / 2, shape.depth / 2, shape.seam + SEAL
    top = low + shape.lid
    slab = box(-w, w, -d, d, low, top)
    case = Surface(texture_srgb=textures.brushed_metal(rng, color, 512), roughness=0.4, metallic=0.4)
    stickers = Surface(texture_srgb=printed.stickers(rng, color), roughness=0.5)
    display = Surface(texture_srgb=printed.screen(rng), roughness=0.2)
    rim = Surface(color_srgb=(0.05, 0.05, 0.06))
    bar = Surface(texture_srgb=textures.plastic(rng, (0.12, 0.12, 0.13), 128), roughness=0.5)
    edge, frame = 0.012, shape.bezel
    below = low - PRINT
    size = (2 * (w - frame), 2 * d - 2 * frame)
    meshes = (
        boxes_mesh("lid", [slab], case),
        panel(
            "stickers",
            (-w + edge, -d + edge, top + PRINT),
            (2 * (w - edge), 0, 0),
            (0, 2 * (d - edge), 0),
            stickers,
        ),
        # Upright for the user once the lid is open: its top is the free edge.
        panel("bezel", (-w, d, low - PRINT / 2), (2 * w, 0, 0), (0, -2 * d, 0), rim),
        panel("screen", (-w + frame, d - frame, below), (size[0], 0, 0), (0, -size[1], 0), display),
        handle.mesh(bar),
    )
    return AssetLink(
        name="lid", meshes=meshes, colliders=(slab.collider("lid"), *handle.colliders()), mass=shape.lid_mass
    )
