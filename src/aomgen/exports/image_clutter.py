"""Clutter on the table of labeled images: boxes, cans and objects of other categories, in the light of the scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from aomgen.assets.choice import MAKERS, make_asset
from aomgen.assets.procedural import textures
from aomgen.assets.procedural.builder import pick
from aomgen.assets.procedural.shapes import AlignedBox, Material, boxes_mesh, rod
from aomgen.conventions import srgb_from_linear
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.light import Light
from aomgen.core.mesh import Mesh
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, transform
from aomgen.core.values import Array
from aomgen.splatting.surfels import Surfels, surfels_of

# Number of different boxes and cans of an export, largest number in a scene, and number of discs of each.
KINDS, MOST, DISCS = 24, 4, 900
# Ranges of the sides of a box, and of the radius and height of a can, [m].
BOX_M, RADIUS_M, HEIGHT_M = (0.03, 0.16), (0.02, 0.05), (0.05, 0.2)
# Range of their colors, sRGB; and width of the empty margin of the table, [m].
COLORS, MARGIN_M = (0.1, 0.95), 0.1
SURFACES: Final = (textures.plastic, textures.make_speckles, textures.wood, textures.make_brushed_metal)
# Number of different objects of each category of an export, range of their sizes, and number of discs of each.
OBJECTS, SCALE, OBJECT_DISCS = 3, (0.5, 0.8), 9000
# Radius of the disc that an object occupies, relative to half the diagonal of its footprint.
GAP: Final = 1.1
# Share of the scenes in which an object of another category is placed if there is room, largest angle between its front and that
# of the labeled object, [deg], and number of places that are tried.
SHARE, FACING_DEG, TRIES = 0.4, 60.0, 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Clutter:
    """Something on the table, in a frame with z = 0 at its bottom.

    Attributes:
        surfels: Its surface.
        radius_m: Distance of the outermost point from the z axis, [m].
        category: Category of an articulated object, whose front faces -y; empty for boxes and cans.
    """

    surfels: Surfels
    radius_m: float
    category: str = ""


def make_clutter(rng: np.random.Generator) -> list[Clutter]:
    """Make boxes and cans, and small closed objects of all categories."""
    objects = [_make_object(category, rng) for category in MAKERS for _ in range(OBJECTS)]
    return [*(_make_item(rng) for _ in range(KINDS)), *objects]


def _make_item(rng: np.random.Generator) -> Clutter:
    color = rng.uniform(*COLORS, 3)
    surface = Material(texture_srgb=pick(rng, SURFACES)(rng, color), tile_m=0.3, roughness=0.5)
    if rng.random() < 0.6:
        x, y, z = rng.uniform(*BOX_M, 3)
        block = AlignedBox(lower=(-x / 2, -y / 2, 0.0), upper=(x / 2, y / 2, z), skip="")
        mesh = boxes_mesh("box", [block], surface)
    else:
        mesh = rod("can", (0, 0, 0), (0, 0, rng.uniform(*HEIGHT_M)), rng.uniform(*RADIUS_M), surface)
    return _cover([mesh], DISCS, rng)


def _make_object(category: str, rng: np.random.Generator) -> Clutter:
    made = make_asset(category, int(rng.integers(2**31)))
    return cover_object(made.transform(similarity(rng.uniform(*SCALE), np.eye(3), np.zeros(3))), rng)


def cover_object(asset: ArticulatedAsset, rng: np.random.Generator) -> Clutter:
    """Cover a closed object with discs."""
    return _cover([*asset.static.meshes, *asset.moving.meshes], OBJECT_DISCS, rng, asset.category)


def _cover(meshes: Sequence[Mesh], discs: int, rng: np.random.Generator, category: str = "") -> Clutter:
    radius = max(float(np.linalg.norm(mesh.vertices[:, :2], axis=1).max()) for mesh in meshes)
    return Clutter(surfels=surfels_of(meshes, discs, rng), radius_m=radius, category=category)


class ClutterPlacer:
    """Placement of clutter on a table, lit by a light.

    Args:
        light: Light on new objects.
        T_world_plane: Pose of the table's surface.
        free: Lower and upper corner (2,) of the table, world frame, [m].
    """

    def __init__(self, light: Light, T_world_plane: Array, free: tuple[Array, Array]) -> None:
        self._light, self._T_world_plane, self._free = light, T_world_plane, free

    def place(
        self,
        items: Sequence[Clutter],
        category: str,
        R_world_object: Array,
        taken: tuple[Array, float],
        rng: np.random.Generator,
    ) -> list[Gaussians]:
        """Place up to `MOST` boxes and cans, and possibly one object of another category, at random.

        Args:
            items: Result of `make_clutter`.
            category: Category of the labeled object.
            R_world_object: Its orientation (3, 3).
            taken: Center (2,) and radius of the disc that it occupies, world frame, [m].
        """
        placed = []
        if rng.random() < SHARE:
            others = [item for item in items if item.category not in ("", category)]
            item = others[int(rng.integers(len(others)))]
            T = self.find_place(item, R_world_object, taken, rng)
            placed += [] if T is None else [self.light_item(item, T)]
        small = [item for item in items if not item.category]
        for _ in range(int(rng.integers(0, MOST + 1))):
            item = small[int(rng.integers(len(small)))]
            at = rng.uniform(self._free[0] + MARGIN_M, self._free[1] - MARGIN_M)
            if np.linalg.norm(at - taken[0]) >= taken[1]:
                R = self._T_world_plane[:3, :3] @ _turn_about_z(rng.uniform(0, 2 * np.pi))
                placed.append(self.light_item(item, self._put_down(R, at)))
        return placed

    def find_place(
        self, item: Clutter, R_world_object: Array, taken: tuple[Array, float], rng: np.random.Generator
    ) -> Array | None:
        """Sample a pose (4, 4) of an object next to the labeled one; None if there is no room."""
        for _ in range(TRIES):
            at = rng.uniform(*self._free)
            if np.linalg.norm(at - taken[0]) > taken[1] + item.radius_m:
                turn = np.radians(rng.uniform(-FACING_DEG, FACING_DEG))
                return self._put_down(R_world_object @ _turn_about_z(turn), at)
        return None

    def light_item(self, item: Clutter, T_world_item: Array) -> Gaussians:
        """Return the Gaussians of an item at a pose (4, 4), in its light, world frame."""
        surfels = item.surfels
        arriving = np.maximum(surfels.transfer @ self._light.view_from(T_world_item[:3, :3]), 0)
        colors = srgb_from_linear(np.minimum(arriving * surfels.albedo_linear, 1))
        sh = ((colors - 0.5) / SH_C0)[:, None].astype(np.float32)
        return surfels.gaussians.with_sh(sh).transform(T_world_item)

    def _put_down(self, R_world_item: Array, at: Array) -> Array:
        """Return the pose (4, 4) of an item that stands at a position `at` (2,) on the table."""
        normal, origin = self._T_world_plane[:3, 2], self._T_world_plane[:3, 3]
        # The height of the surface at this position.
        z = origin[2] - float((at - origin[:2]) @ normal[:2]) / normal[2]
        return transform(R_world_item, [*at, z])


def find_footprint(fitted: FittedAsset, T_world_object: Array) -> tuple[Array, float]:
    """Compute center (2,) and radius of a disc that an object at a pose (4, 4) occupies, world frame, [m]."""
    low, high = fitted.asset.static.bounds
    middle = apply(T_world_object, fitted.middle_asset)[:2]
    return middle, GAP * float(np.linalg.norm((high - low)[:2])) / 2


def _turn_about_z(angle_rad: float) -> Array:
    return matrix_from_rotvec([0.0, 0.0, angle_rad])
