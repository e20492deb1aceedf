"""Textured shapes of which parametric assets consist: boxes, rounded boxes, rods, domes and printed panels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.asset import BoxCollider
from aomgen.core.mesh import NUMBERS, Mesh
from aomgen.core.transforms import make_tangent_basis, transform
from aomgen.core.values import Array

# Distance between a print and its surface, [m]: large enough to avoid z-fighting, too small to be visible.
PRINT_GAP = 0.0006
# The two in-plane axes (u, v) of a face whose normal is axis x, y or z.
_PLANE_AXES = ((1, 2), (0, 2), (0, 1))
NO_TEXTURE = np.zeros((0, 0, 3), np.uint8)
# Smallest number of steps of a rounded edge, and length of a step relative to its smaller radius, [m].
LEAST_STEPS, STEP = 4, 0.006
# All four edges of a box along an axis.
ALL_EDGES: Final = ((-1, -1), (1, -1), (1, 1), (-1, 1))
# The two edges on the high side of the second of the other axes.
UPPER_EDGES: Final = ((1, 1), (-1, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Color, texture and reflectance of a mesh.

    Attributes:
        texture_srgb: Color texture (H, W, 3), uint8; if it is empty, `color_srgb` is used.
        color_srgb: Color (3,), 0..1.
        tile_m: Edge length of the texture on planar-mapped parts, [m].
        roughness, metallic, opacity: Parameters of UsdPreviewSurface, 0..1.
        maps: Images that replace single parameters; see `Mesh`.
    """

    texture_srgb: NDArray[np.uint8] = field(default_factory=lambda: NO_TEXTURE)
    color_srgb: tuple[float, float, float] = (0.8, 0.8, 0.8)
    tile_m: float = 0.6
    roughness: float = 0.6
    metallic: float = 0.0
    opacity: float = 1.0
    maps: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    def mesh(self, name: str, vertices: Array, faces: NDArray[np.int64], uvs: Array) -> Mesh:
        """Build a mesh with this material.

        Args:
            name: Name of the mesh.
            vertices: Points (V, 3), [m].
            faces: Vertex indices of triangles (F, 3).
            uvs: Texture coordinates (F, 3, 2); if they are empty, textures and maps are replaced by their means.
        """
        texture, textured = self.texture_srgb, len(uvs) > 0
        numbers = {
            key: float(self.maps[key].mean() / 255) if key in self.maps else getattr(self, key)
            for key in NUMBERS
        }
        return Mesh(
            name=name,
            vertices=vertices,
            faces=faces,
            uvs=uvs if texture.size or self.maps else np.zeros((0, 3, 2)),
            texture_srgb=texture if textured else NO_TEXTURE,
            color_srgb=_mean_color(texture) if texture.size else np.asarray(self.color_srgb),
            maps=self.maps if textured else {},
            **numbers,
        )


def _mean_color(texture_srgb: NDArray[np.uint8]) -> Array:
    """Compute the mean color (3,), 0..1, of a texture (H, W, 3)."""
    height, width, _ = texture_srgb.shape
    # Summing along one axis at a time is several times faster than summing over all pixels at once.
    return np.asarray(texture_srgb.sum(0, dtype=np.uint32).sum(0) / (height * width) / 255, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedBox:
    """Axis-aligned box between two corners (3,), [m]; `skip` names faces without triangles.

    Face names are "x", "y", "z" on the low side and "X", "Y", "Z" on the high side.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    skip: str = ""

    def mirror(self) -> "AlignedBox":
        """Mirror the box at the plane x = 0."""
        (x0, y0, z0), (x1, y1, z1) = self.lower, self.upper
        return box(-x1, -x0, y0, y1, z0, z1, self.skip.translate(str.maketrans("xX", "Xx")))

    def collider(self, name: str) -> BoxCollider:
        """Return the box as a collider."""
        lower, upper = np.array(self.lower), np.array(self.upper)
        pose = transform(np.eye(3), (lower + upper) / 2)
        return BoxCollider(name=name, T_asset_box=pose, half_extents=(upper - lower) / 2)


def box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, skip: str = "") -> AlignedBox:
    """Build an `AlignedBox` from its six planes, [m]."""
    return AlignedBox(lower=(x0, y0, z0), upper=(x1, y1, z1), skip=skip)


def boxes_mesh(name: str, boxes: Sequence[AlignedBox], surface: Material) -> Mesh:
    """Build one planar-mapped mesh from several boxes: u runs along x (or y), v along z (or y).

    Texture coordinates start at the lowest corner of the mesh and stay within 0..1, so a mesh larger than a tile stretches
    the texture instead of repeating it.
    """
    sides = product(boxes, range(3), (False, True))
    corners = np.array([
        _box_face(item, axis, high)
        for item, axis, high in sides
        if ("xyz", "XYZ")[high][axis] not in item.skip
    ])  # fmt: skip
    return _planar_mesh(name, _halves(corners), surface)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundedBox:
    """A box with rounded or beveled edges along one axis.

    Attributes:
        whole: The box before rounding; all of its faces are visible.
        axis: Direction of the edges: 0, 1 or 2.
        radii: Extent of the rounding along the two other axes, in their order, [m].
        corners: The rounded edges, given by their sides (-1 or 1) along these axes.
        bevel: The edges are beveled instead of rounded.
    """

    whole: AlignedBox
    axis: int
    radii: tuple[float, float]
    corners: tuple[tuple[int, int], ...]
    bevel: bool = False

    def boxes(self) -> list[AlignedBox]:
        """Approximate the shape by slices for colliders; the slice between the rounded edges is first."""
        u, v = _PLANE_AXES[self.axis]
        lower, upper = np.array(self.whole.lower), np.array(self.whole.upper)
        along, across = self._profile()
        found = []
        for side in sorted({side for side, _ in self.corners}):
            edge = upper[u] if side > 0 else lower[u]
            start = edge - side * self.radii[0]
            (upper if side > 0 else lower)[u] = start
            for i in range(len(along) - 1):
                low, high = np.array(self.whole.lower), np.array(self.whole.upper)
                low[u], high[u] = sorted(start + side * self.radii[0] * along[i : i + 2])
                cut = self.radii[1] * (1 - across[i : i + 2].mean())
                low[v] += cut * ((side, -1) in self.corners)
                high[v] -= cut * ((side, 1) in self.corners)
                found.append(_box_between(low, high))
        return [_box_between(lower, upper), *found]

    def mesh(self, name: str, surface: Material) -> Mesh:
        """Build the surface, with the same mapping as `boxes_mesh`."""
        (u, v), outline = _PLANE_AXES[self.axis], self._outline()
        rings = np.empty((2, len(outline), 3))
        rings[:, :, [u, v]] = outline
        rings[:, :, self.axis] = [[self.whole.lower[self.axis]], [self.whole.upper[self.axis]]]
        low, high = rings
        after = np.roll(np.arange(len(outline)), -1)
        sides = _halves(np.stack([low, low[after], high[after], high], 1))
        fans = [np.stack([ring[:1].repeat(len(ring) - 2, 0), ring[1:-1], ring[2:]], 1) for ring in rings]
        triangles = np.concatenate([sides, fans[0][:, ::-1], fans[1]])
        # For edges along y, the other axes (x, z) form a left-handed system with y, so the triangles are reversed.
        return _planar_mesh(name, triangles[:, ::-1] if self.axis == 1 else triangles, surface)

    def _profile(self) -> tuple[Array, Array]:
        """Compute points of a rounded edge from one face to the next, relative to its center, in units of the radii."""
        steps = max(LEAST_STEPS, int(np.ceil(min(self.radii) / STEP)))
        shares = np.linspace(0.0, 1.0, steps + 1, dtype=np.float64)
        if self.bevel:
            return shares, 1.0 - shares
        turns = shares * np.pi / 2
        return np.sin(turns, dtype=np.float64), np.cos(turns, dtype=np.float64)

    def _outline(self) -> Array:
        """Compute the outline (N, 2) along the other two axes, counterclockwise."""
        axes = list(_PLANE_AXES[self.axis])
        bounds = np.array([self.whole.lower, self.whole.upper])[:, axes]
        profile = np.stack(self._profile(), 1)
        points = []
        for sides in ALL_EDGES:
            corner = np.array([bounds[(side + 1) // 2, i] for i, side in enumerate(sides)])
            if sides not in self.corners:
                points.append(corner[None])
                continue
            ordered = profile[::-1] if sides[0] * sides[1] > 0 else profile
            points.append(corner - np.multiply(sides, self.radii) * (1.0 - ordered))
        return np.concatenate(points)


def _box_between(lower: Array, upper: Array) -> AlignedBox:
    (x0, y0, z0), (x1, y1, z1) = lower.tolist(), upper.tolist()
    return box(x0, x1, y0, y1, z0, z1)


def panel(name: str, corner: ArrayLike, right: ArrayLike, up: ArrayLike, surface: Material) -> Mesh:
    """Build a rectangle that shows a whole texture upright.

    Args:
        name: Name of the mesh.
        corner: Lower left corner as seen from outside (3,), [m].
        right, up: Edges from this corner (3,), [m]; the outward normal is their cross product.
        surface: Material with the texture.
    """
    corner, right, up = (np.asarray(v, np.float64) for v in (corner, right, up))
    quad = np.stack([corner, corner + right, corner + right + up, corner + up])
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    return _quads_mesh(name, quad[None], uvs[None], surface)


def rod(
    name: str, start: ArrayLike, end: ArrayLike, radius: float, surface: Material, sides: int = 14
) -> Mesh:
    """Build a closed cylinder; the texture is wrapped once around it.

    Args:
        name: Name of the mesh.
        start, end: Centers of the two end faces (3,), [m].
        radius: Radius, [m].
        surface: Material.
        sides: Number of side faces.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    along = (end - start) / np.linalg.norm(end - start)
    first, second = make_tangent_basis(along)
    angles = np.arange(sides + 1) * 2 * np.pi / sides
    ring = radius * (np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second)
    share = angles / (2 * np.pi)
    length = min(1.0, float(np.linalg.norm(end - start)) / surface.tile_m)
    triangles, uvs = [], []
    for i in range(sides):
        a, b, c, d = start + ring[i], start + ring[i + 1], end + ring[i + 1], end + ring[i]
        # u runs along the rod, so that brush marks and grain of a texture do, too.
        uv_a, uv_b, uv_c, uv_d = (0, share[i]), (0, share[i + 1]), (length, share[i + 1]), (length, share[i])
        triangles += [(a, b, c), (a, c, d), (start, b, a), (end, d, c)]
        middle = (0.0, 0.5)
        uvs += [(uv_a, uv_b, uv_c), (uv_a, uv_c, uv_d), (middle, uv_b, uv_a), (middle, uv_d, uv_c)]
    return _triangles_mesh(name, np.array(triangles), np.array(uvs), surface)


def dome(name: str, center: ArrayLike, radii: ArrayLike, surface: Material) -> Mesh:
    """Build the upper half of an ellipsoid with a center (3,) and radii (3,), [m]; the texture is projected along z."""
    around = np.arange(21) * 2 * np.pi / 20
    up = np.linspace(0.0, np.pi / 2, 6)
    unit = np.stack(
        [
            np.cos(up)[:, None] * np.cos(around),
            np.cos(up)[:, None] * np.sin(around),
            np.broadcast_to(np.sin(up)[:, None], (len(up), len(around))),
        ],
        -1,
    )
    quads = np.stack([unit[:-1, :-1], unit[:-1, 1:], unit[1:, 1:], unit[1:, :-1]], 2).reshape(-1, 4, 3)
    uvs = 0.5 + 0.5 * quads[..., :2]
    return _quads_mesh(name, np.asarray(center) + quads * np.asarray(radii), uvs, surface)


def merge_meshes(name: str, meshes: Sequence[Mesh]) -> Mesh:
    """Merge meshes into one with the material of the first."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return replace(
        meshes[0],
        name=name,
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + offset for m, offset in zip(meshes, offsets, strict=True)]),
        uvs=np.concatenate([m.uvs for m in meshes]),
    )


def _box_face(item: AlignedBox, axis: int, high: bool) -> Array:
    """Compute the corners (4, 3) of one face, counterclockwise as seen from outside."""
    low, top = np.array(item.lower), np.array(item.upper)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    quad = np.empty((4, 3))
    quad[:, axis] = top[axis] if high else low[axis]
    quad[:, i] = [low[i], top[i], top[i], low[i]]
    quad[:, j] = [low[j], low[j], top[j], top[j]]
    return quad if high else quad[::-1]


def _quads_mesh(name: str, corners: Array, uvs: Array, surface: Material) -> Mesh:
    return _triangles_mesh(name, _halves(corners), _halves(uvs), surface)


def _halves(quads: Array) -> Array:
    """Split each quad (N, 4, D) into two triangles (2 N, 3, D)."""
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, quads.shape[-1])


def _planar_mesh(name: str, triangles: Array, surface: Material) -> Mesh:
    """Build a mesh of triangles (N, 3, 3), each mapped along the axis closest to its normal; see `boxes_mesh`."""
    low = triangles.min((0, 1))
    tile = max(surface.tile_m, float((triangles.max((0, 1)) - low).max()))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    axes = np.array(_PLANE_AXES)[np.abs(normals).argmax(1)]
    uvs = np.take_along_axis(triangles - low, axes[:, None, :], 2) / tile
    return _triangles_mesh(name, triangles, uvs, surface)


def _triangles_mesh(name: str, triangles: Array, uvs: Array, surface: Material) -> Mesh:
    vertices, inverse = np.unique(np.round(triangles.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return surface.mesh(name, vertices, inverse.reshape(-1, 3), uvs)
