"""Clutter on the table of labeled images: boxes and cans in the light of the scene."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import pick
from aomgen.assets.procedural.shapes import AlignedBox, Material, boxes_mesh, rod
from aomgen.conventions import srgb_from_linear
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import Light
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.splatting.surfels import Surfels, surfels_of

# Number of different objects of an export, largest number in a scene, and number of discs per object.
KINDS, MOST, DISCS = 24, 4, 900
# Ranges of the sides of a box, and of the radius and height of a can, [m].
BOX_M, RADIUS_M, HEIGHT_M = (0.03, 0.16), (0.02, 0.05), (0.05, 0.2)
# Range of their colors, sRGB; and width of the empty margin of the table, [m].
COLORS, MARGIN_M = (0.1, 0.95), 0.1
SURFACES: Final = (textures.plastic, textures.make_speckles, textures.wood, textures.make_brushed_metal)


def make_clutter(rng: np.random.Generator) -> list[Surfels]:
    """Make small objects, each in a frame with z = 0 at its bottom."""
    return [_make_item(rng) for _ in range(KINDS)]


def _make_item(rng: np.random.Generator) -> Surfels:
    color = rng.uniform(*COLORS, 3)
    surface = Material(texture_srgb=pick(rng, SURFACES)(rng, color), tile_m=0.3, roughness=0.5)
    if rng.random() < 0.6:
        x, y, z = rng.uniform(*BOX_M, 3)
        block = AlignedBox(lower=(-x / 2, -y / 2, 0.0), upper=(x / 2, y / 2, z), skip="")
        mesh = boxes_mesh("box", [block], surface)
    else:
        mesh = rod("can", (0, 0, 0), (0, 0, rng.uniform(*HEIGHT_M)), rng.uniform(*RADIUS_M), surface)
    return surfels_of([mesh], DISCS, rng)


def place_clutter(
    items: Sequence[Surfels],
    light: Light,
    T_world_plane: Array,
    free: tuple[Array, Array],
    taken: tuple[Array, float],
    rng: np.random.Generator,
) -> list[Gaussians]:
    """Place up to `MOST` of the items at random on a table, lit by a light.

    Args:
        items: Result of `make_clutter`.
        light: Light on new objects.
        T_world_plane: Pose of the table's surface.
        free: Lower and upper corner (2,) of the table, world frame, [m].
        taken: Center (2,) and radius of a disc that remains free, world frame, [m].
    """
    placed = []
    for _ in range(int(rng.integers(0, MOST + 1))):
        item = items[int(rng.integers(len(items)))]
        at = rng.uniform(free[0] + MARGIN_M, free[1] - MARGIN_M)
        if np.linalg.norm(at - taken[0]) < taken[1]:
            continue
        R = T_world_plane[:3, :3] @ matrix_from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        # The height of the surface at this position.
        normal, origin = T_world_plane[:3, 2], T_world_plane[:3, 3]
        z = origin[2] - float((at - origin[:2]) @ normal[:2]) / normal[2]
        exitant = np.maximum(item.transfer @ light.view_from(R), 0) * item.albedo_linear
        colors = srgb_from_linear(np.minimum(exitant, 1))
        sh = ((colors - 0.5) / SH_C0)[:, None].astype(np.float32)
        placed.append(item.gaussians.with_sh(sh).transform(transform(R, [*at, z])))
    return placed
