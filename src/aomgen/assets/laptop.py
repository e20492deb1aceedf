"""A parametric laptop that lies flat: thin base with a notch in front, thin lid held by its front edge."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets import decals, textures
from aomgen.assets.lid import SEAL, back_hinge
from aomgen.assets.shapes import PRINT_GAP, Material, box, boxes_mesh, panel, rod
from aomgen.core.asset import ArticulatedAsset, AssetLink
from aomgen.core.mesh import Mesh

# Colors of usual cases (silver, black, blue, copper), sRGB 0..1; the maker's taste.
CASES = ((0.66, 0.67, 0.69), (0.20, 0.21, 0.23), (0.34, 0.40, 0.48), (0.72, 0.62, 0.54))
# Height of the rubber strips below the base, [m].
FEET = 0.002
# Depth of the lid's rim that a gripper holds, and how far inside of the edge it is held, [m].
RIM, HELD = 0.016, 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class LaptopShape:
    """Sizes of one laptop, [m], [rad], [kg].

    Attributes:
        width, depth: Of base and lid.
        base, lid: Thickness.
        notch: Width and depth of the recess in the base's front, in which the lid stands out.
        bezel: Width of the frame around the screen.
        opening: Largest turn of the lid.
        base_mass, lid_mass: As they say.
    """

    width: float
    depth: float
    base: float
    lid: float
    notch: tuple[float, float]
    bezel: float
    opening: float
    base_mass: float
    lid_mass: float

    @property
    def seam(self) -> float:
        """Height of the base's upper side."""
        return FEET + self.base


def draw_shape(rng: np.random.Generator) -> LaptopShape:
    """Random but realistic sizes."""
    width = rng.uniform(0.28, 0.38)
    return LaptopShape(
        width=width,
        depth=width * rng.uniform(0.66, 0.72),
        base=rng.uniform(0.012, 0.020),
        lid=rng.uniform(0.005, 0.009),
        notch=(rng.uniform(0.066, 0.080), rng.uniform(0.012, 0.015)),
        bezel=rng.uniform(0.006, 0.012),
        opening=np.deg2rad(rng.uniform(115, 135)),
        base_mass=rng.uniform(1.2, 2.2),
        lid_mass=rng.uniform(0.4, 0.7),
    )


def make_laptop(name: str, rng: np.random.Generator) -> ArticulatedAsset:
    """One closed laptop; every size, color and print comes from `rng`."""
    shape = draw_shape(rng)
    color = CASES[rng.integers(len(CASES))]
    return ArticulatedAsset(
        name=name,
        category="laptop",
        static=_base(shape, color, rng),
        moving=_lid(shape, color, rng),
        joint=back_hinge(shape.depth, shape.seam, shape.opening),
        handle_point=np.array([0.0, HELD - shape.depth / 2, shape.seam + SEAL + shape.lid / 2]),
        handle_axis=np.array([1.0, 0.0, 0.0]),
    )


def _base(shape: LaptopShape, color: tuple[float, float, float], rng: np.random.Generator) -> AssetLink:
    w, d, top = shape.width / 2, shape.depth / 2, shape.seam
    half, inner = shape.notch[0] / 2, shape.notch[1] - d
    slabs = {
        "base": box(-w, w, inner, d, FEET, top),
        "front_left": box(-w, -half, -d, inner, FEET, top, "Y"),
        "front_right": box(half, w, -d, inner, FEET, top, "Y"),
    }
    feet = {
        f"foot_{name}": box(-0.8 * w, 0.8 * w, y - 0.004, y + 0.004, 0.0, FEET, "Z")
        for name, y in (("front", 0.03 - d), ("back", d - 0.02))
    }
    case = Material(texture_srgb=textures.brushed_metal(rng, color, 512), roughness=0.4, metallic=0.4)
    keys = Material(texture_srgb=decals.keyboard(rng, color), roughness=0.6)
    black = Material(color_srgb=(0.06, 0.06, 0.07))
    front = inner + 0.003
    hinge = (d, top + SEAL / 2)
    meshes = (
        boxes_mesh("base", list(slabs.values()), case),
        boxes_mesh("feet", list(feet.values()), black),
        panel(
            "keys",
            (-w + 0.006, front, top + PRINT_GAP),
            (2 * w - 0.012, 0, 0),
            (0, d - 0.006 - front, 0),
            keys,
        ),
        *(
            rod(
                f"hinge_{side}",
                (0.66 * sign * w - 0.03, *hinge),
                (0.66 * sign * w + 0.03, *hinge),
                0.003,
                black,
            )
            for side, sign in (("left", -1.0), ("right", 1.0))
        ),
    )
    colliders = tuple(solid.collider(key) for key, solid in {**slabs, **feet}.items())
    return AssetLink(name="base", meshes=meshes, colliders=colliders, mass=shape.base_mass)


def _lid(shape: LaptopShape, color: tuple[float, float, float], rng: np.random.Generator) -> AssetLink:
    w, d, low = shape.width / 2, shape.depth / 2, shape.seam + SEAL
    top = low + shape.lid
    slab = box(-w, w, RIM - d, d, low, top, "y")
    rim = box(-w, w, -d, RIM - d, low, top, "Y")
    case = Material(texture_srgb=textures.brushed_metal(rng, color, 512), roughness=0.4, metallic=0.4)
    display = Material(texture_srgb=decals.screen(rng), roughness=0.2)
    frame = Material(color_srgb=(0.05, 0.05, 0.06))
    bezel, below = shape.bezel, low - PRINT_GAP
    size = (2 * (w - bezel), 2 * d - 2 * bezel)
    meshes = (
        boxes_mesh("lid", [slab, rim], case),
        _print(shape, color, top + PRINT_GAP, rng),
        # Upright for the user once the lid is open: its top is the free edge.
        panel("bezel", (-w, d, low - PRINT_GAP / 2), (2 * w, 0, 0), (0, -2 * d, 0), frame),
        panel("screen", (-w + bezel, d - bezel, below), (size[0], 0, 0), (0, -size[1], 0), display),
    )
    colliders = (slab.collider("lid"), rim.collider("handle_rim"))
    return AssetLink(name="lid", meshes=meshes, colliders=colliders, mass=shape.lid_mass)


def _print(
    shape: LaptopShape, color: tuple[float, float, float], height: float, rng: np.random.Generator
) -> Mesh:
    """On the lid: the maker's name alone, or stickers all over it."""
    if rng.random() < 0.5:
        name = Material(texture_srgb=textures.nameplate(rng, color, 256, 64), roughness=0.4)
        return panel("name", (0.04, -0.01, height), (-0.08, 0, 0), (0, -0.02, 0), name)
    w, d = shape.width / 2 - 0.012, shape.depth / 2 - 0.012
    art = Material(texture_srgb=decals.stickers(rng, color, count=int(rng.integers(2, 8))), roughness=0.5)
    return panel("stickers", (-w, -d, height), (2 * w, 0, 0), (0, 2 * d, 0), art)
