"""Meshes as Gaussians: flat discs spread evenly over the surface.

Each disc keeps its normal, its albedo and its transfer (`core.light`), so that it can be lit
again wherever it goes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from aomgen.conventions import linear_from_srgb
from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.light import open_transfer
from aomgen.core.mesh import NORMAL_MAP, NUMBERS, Mesh, face_normals_areas, sample_surface
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import AssetError
from aomgen.io.images import resize

# Candidates drawn for each disc that is kept; more gives a more even spread.
OVERSAMPLING: Final = 5
# Density of a Poisson-disc set of radius r is about this over r^2.
DISC_DENSITY: Final = 0.7
# Standard deviation of a disc over its radius: wide enough that neighbours close the surface.
SPREAD: Final = 0.87
# Thickness of a disc over its radius.
THICKNESS: Final = 0.05
# The most that the engine blends for one Gaussian: a surface hides what is behind it.
OPACITY: Final = 0.99
# A surface this opaque keeps light from what is behind it; one less opaque than the second is not there.
HIDES, UNSEEN = 0.5, 0.02
# Discs are this much finer where the texture changes or an edge is near.
FINER: Final = 0.5
# Difference of sRGB between a fine and a coarse look at the texture that counts as detail.
DETAIL: Final = 0.04
# Cosine between normals from which on two surfaces lie on each other.
PARALLEL: Final = 0.98
# Two faces that turn by more than this meet in a crease.
CREASE_COSINE = float(np.cos(np.deg2rad(30.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Surfels:
    """Discs of one link.

    Attributes:
        gaussians: N discs colored with their albedo, as opaque as the meshes, in the frame of the meshes.
        normals: Unit, outward.
        bends: Tangential offsets of the normals by normal maps.
        albedo_linear: 0..1.
        transfer: See `core.light`.
        roughness, metallic: Values of the meshes, 0..1.
    """

    gaussians: Annotated[Gaussians, "N"]
    normals: Annotated[NDArray[np.float32], "N 3"]
    bends: Annotated[NDArray[np.float32], "N 3"]
    albedo_linear: Annotated[NDArray[np.float32], "N 3"]
    transfer: Annotated[NDArray[np.float32], "N 9"]
    roughness: Annotated[NDArray[np.float32], "N"]
    metallic: Annotated[NDArray[np.float32], "N"]

    __post_init__ = freeze_arrays

    @property
    def shading_normals(self) -> NDArray[np.float32]:
        """Unit normals (N, 3) that light falls on."""
        return bend_normals(self.normals, self.bends)


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Points on the surface among which discs are chosen; N of each."""

    points: Array
    normals: Array
    bends: Array
    crease_distances: Array
    crease_directions: Array
    colors_srgb: Array
    opacity: Array
    roughness: Array
    metallic: Array
    fine: NDArray[np.bool_]

    def select(self, which: NDArray) -> "_Candidates":
        return _Candidates(*(getattr(self, name)[which] for name in _Candidates.__slots__))


def surfels_of(
    meshes: Sequence[Mesh], count: int, rng: np.random.Generator, oversampling: float = OVERSAMPLING
) -> Surfels:
    """Cover the meshes of one rigid link with discs, each of which sees the whole sky: `count` within about a third.

    `oversampling` is the number of candidates for each disc. Not checked: normals are those of the triangles, outward
    only where the meshes are wound so.

    Raises:
        AssetError: The meshes have no surface.
    """
    areas = np.array([face_normals_areas(mesh.vertices, mesh.faces)[1].sum() for mesh in meshes])
    total = float(areas.sum())
    if not total > 0:
        raise AssetError("mesh", "has no surface to cover", "check the asset's meshes")
    guess = float(np.sqrt(DISC_DENSITY * total / count))
    parts = [
        _candidates(mesh, max(int(oversampling * count * area / total), 64), guess, rng)
        for mesh, area in zip(meshes, areas, strict=True)
        if area > 0
    ]
    if not any(len(part.points) for part in parts):
        raise AssetError("mesh", "is wholly transparent", "check the opacity of its materials")
    fine_shares = [part.fine.mean() if len(part.fine) else 0.0 for part in parts]
    fine_area = float(np.dot(fine_shares, areas[areas > 0]))
    radius = guess * float(np.sqrt(1 + (FINER**-2 - 1) * fine_area / total))
    parts = _select_uncovered(parts, radius)
    # A mesh is thinned alone: a sticker must not lose its discs to the wall it lies on.
    chosen = [_thin(part, radius, rng) for part in parts]
    return _discs(_join([part for part, _ in chosen]), np.concatenate([radii for _, radii in chosen]))


def hiding_points(meshes: Sequence[Mesh], count: int, rng: np.random.Generator) -> Array:
    """Some `count` points (M, 3) spread evenly over what light does not pass; over all of it where it passes everything."""
    areas = np.array([face_normals_areas(mesh.vertices, mesh.faces)[1].sum() for mesh in meshes])
    hiding, passing = [], []
    for mesh, share in zip(meshes, areas / areas.sum(), strict=True):
        if share > 0:
            number = int(np.ceil(count * share))
            points, face_ids, weights = sample_surface(mesh.vertices, mesh.faces, number, rng)
            image = mesh.maps.get("opacity")
            opacity = _sample(mesh, face_ids, weights, 0.0, image, [mesh.opacity])[:, 0]
            hiding.append(points[opacity > HIDES])
            passing.append(points)
    found = np.concatenate(hiding)
    return found if len(found) else np.concatenate(passing)


def _candidates(mesh: Mesh, count: int, radius: float, rng: np.random.Generator) -> _Candidates:
    # Twice as many where every second one may fall into a finer class.
    points, face_ids, weights = sample_surface(mesh.vertices, mesh.faces, 2 * count, rng)
    distances, directions = crease_distances(mesh.vertices, mesh.faces, face_ids, points)
    places = mesh, face_ids, weights
    color = {"image": mesh.texture_srgb, "else_value": mesh.color_srgb}
    colors = _sample(*places, radius * FINER, **color)
    opacity, roughness, metallic = (
        _sample(*places, radius * FINER, mesh.maps.get(name), [getattr(mesh, name)])[:, 0] for name in NUMBERS
    )
    normals, _ = face_normals_areas(mesh.vertices, mesh.faces)
    detailed = np.abs(colors - _sample(*places, radius * 3, **color)).max(1) > DETAIL
    if "opacity" in mesh.maps:
        coarse = _sample(*places, radius * 3, mesh.maps["opacity"], [1.0])[:, 0]
        detailed |= np.abs(opacity - coarse) > DETAIL
    found = _Candidates(
        points=points,
        normals=normals[face_ids],
        bends=_bends(mesh, face_ids, weights, radius * FINER),
        crease_distances=distances,
        crease_directions=directions,
        colors_srgb=colors,
        opacity=opacity,
        roughness=roughness,
        metallic=metallic,
        fine=detailed | (distances < radius * FINER),
    )
    return found.select(opacity > UNSEEN) if mesh.see_through else found


def _bends(mesh: Mesh, face_ids: NDArray[np.int64], weights: Array, footprint: float) -> Array:
    """Offsets (N, 3) of a normal map to the normals, in the plane of the face; shorter than 1."""
    if NORMAL_MAP not in mesh.maps:
        return np.zeros((len(face_ids), 3))
    local = 2 * _sample(mesh, face_ids, weights, footprint, mesh.maps[NORMAL_MAP], [0.5, 0.5, 1.0]) - 1
    local /= np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-6)
    edges = np.diff(mesh.vertices[mesh.faces[face_ids]], axis=1)
    steps = np.diff(mesh.uvs[face_ids], axis=1)
    # Columns are the directions in space of the texture's u and v.
    along = np.einsum("nkd,nkc->ndc", edges, np.linalg.pinv(steps).transpose(0, 2, 1))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.einsum("ndc,nc->nd", along, local[:, :2])


def bend_normals(normals: NDArray[np.floating], bends: NDArray[np.floating]) -> NDArray[np.floating]:
    """Unit normals (N, 3) with what a normal map adds to them."""
    bent = normals * np.sqrt(1 - np.minimum((bends**2).sum(-1, keepdims=True), 1)) + bends
    return bent / np.linalg.norm(bent, axis=-1, keepdims=True)


def _sample(
    mesh: Mesh,
    face_ids: NDArray[np.int64],
    weights: Array,
    footprint: float,
    image: NDArray[np.uint8] | None,
    else_value: ArrayLike,
) -> Array:
    """Values (N, C), 0..1, of an image at points on faces, averaged over about `footprint` [m]; else one value."""
    value = np.asarray(else_value)
    if image is None or not image.size or not len(mesh.uvs):
        return np.broadcast_to(value, (len(face_ids), len(value)))
    height, width = image.shape[:2]
    a, b, c = (mesh.uvs[:, k] * (width, height) for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    texels = 0.5 * np.abs(ux * vy - uy * vx).sum()
    area = face_normals_areas(mesh.vertices, mesh.faces)[1].sum()
    shrink = max(footprint * np.sqrt(max(texels, 1e-9) / area), 1.0)
    small = resize(image, max(round(width / shrink), 1), max(round(height / shrink), 1))
    uv = np.einsum("nk,nkd->nd", weights, mesh.uvs[face_ids])
    return _bilinear(small.reshape(*small.shape[:2], -1) / 255.0, uv)


def _bilinear(texture: Array, uv: Array) -> Array:
    """Texture values (N, C) at uv (N, 2), v up; it repeats outside 0..1."""
    height, width = texture.shape[:2]
    inside = np.where((uv < 0) | (uv > 1), uv - np.floor(uv), uv)
    places = np.stack([(1 - inside[:, 1]) * height - 0.5, inside[:, 0] * width - 0.5])
    channels = [
        map_coordinates(texture[..., k], places, order=1, mode="nearest") for k in range(texture.shape[2])
    ]
    return np.stack(channels, 1)


def _select_uncovered(parts: list[_Candidates], radius: float) -> list[_Candidates]:
    """Candidates without those that another mesh covers closely, like a wall under a sticker.

    Discs that almost coincide would be blended in an order that changes with the view.
    """
    owners = np.repeat(np.arange(len(parts)), [len(part.points) for part in parts])
    joined = _join(parts)
    lifted = joined.points + joined.normals * (radius / 2)
    distances, nearest = cKDTree(joined.points).query(lifted, k=8, distance_upper_bound=radius)
    near = np.minimum(nearest, len(owners) - 1)
    height = np.einsum("nkd,nd->nk", joined.points[near] - joined.points[:, None], joined.normals)
    parallel = np.abs(np.einsum("nkd,nd->nk", joined.normals[near], joined.normals)) > PARALLEL
    covers = np.isfinite(distances) & (owners[near] != owners[:, None]) & parallel & (height > radius * 1e-3)
    covers &= joined.opacity[near] > HIDES
    covered = covers.any(1)
    kept = [part.select(~covered[owners == i]) for i, part in enumerate(parts)]
    return [part for part in kept if len(part.points)]


def _thin(part: _Candidates, radius: float, rng: np.random.Generator) -> tuple[_Candidates, Array]:
    """Candidates no two of which are nearer than their radius, and the radii."""
    kept = []
    for fine, reach in ((True, radius * FINER), (False, radius)):
        members = np.flatnonzero(part.fine == fine)
        if len(members):
            # Both sides of a thin sheet are kept: the normal is part of the place.
            places = np.column_stack([part.points[members], part.normals[members] * reach])
            kept.append(members[_poisson_discs(places, reach, rng)])
    selected = part.select(np.concatenate(kept))
    return selected, np.where(selected.fine, radius * FINER, radius)


def _poisson_discs(places: Array, reach: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of a largest set with pairwise distance >= reach, chosen in random order."""
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    rank = rng.permutation(len(places))
    first, second = np.where((rank[pairs[:, 0]] < rank[pairs[:, 1]])[:, None], pairs, pairs[:, ::-1]).T
    undecided = np.ones(len(places), bool)
    chosen = np.zeros(len(places), bool)
    while undecided.any():
        live = undecided[first] & undecided[second]
        first, second = first[live], second[live]
        beaten = np.zeros(len(places), bool)
        beaten[second] = True
        winners = undecided & ~beaten
        chosen |= winners
        undecided &= ~winners
        undecided[second[winners[first]]] = False
    return np.flatnonzero(chosen)


def _join(parts: list[_Candidates]) -> _Candidates:
    return _Candidates(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _Candidates.__slots__)
    )


def _discs(kept: _Candidates, radii: Array) -> Surfels:
    """Gaussians with axes along the crease, across it, and along the normal."""
    across = kept.crease_directions
    R = np.stack([np.cross(across, kept.normals), across, kept.normals], -1)
    # Near a crease a disc is only as wide as the room it has, so that outlines stay sharp.
    room = np.clip(kept.crease_distances, 0.35 * radii, SPREAD * radii)
    scales = np.stack([SPREAD * radii, room, THICKNESS * radii], 1)
    gaussians = gaussians_of(
        means=kept.points,
        quats=quat_from_matrix(R),
        scales=scales,
        opacities=np.minimum(kept.opacity, OPACITY),
        sh=((kept.colors_srgb - 0.5) / SH_C0)[:, None],
    )
    return Surfels(
        gaussians=gaussians,
        normals=kept.normals.astype(np.float32),
        bends=kept.bends.astype(np.float32),
        albedo_linear=linear_from_srgb(kept.colors_srgb).astype(np.float32),
        transfer=open_transfer(kept.normals),
        roughness=kept.roughness.astype(np.float32),
        metallic=kept.metallic.astype(np.float32),
    )


def crease_edges(vertices: Array, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (F, 3) of the edges that are creases or borders; edge k joins corners k and k + 1.

    Vertices at the same place count as one, because exporters split them at seams.
    """
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    _, merged = np.unique(np.round(vertices / (size * 1e-6)).astype(np.int64), axis=0, return_inverse=True)
    corners = merged.reshape(-1)[faces]
    pairs = np.sort(np.stack([corners, np.roll(corners, -1, 1)], -1).reshape(-1, 2), 1)
    _, edge_ids, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    edge_ids = edge_ids.reshape(-1)
    normals, _ = face_normals_areas(vertices, faces)
    owners = np.repeat(np.arange(len(faces)), 3)
    # The length of the sum of the unit normals at an edge gives the angle between two of them.
    total = np.zeros((len(counts), 3))
    np.add.at(total, edge_ids, normals[owners])
    flat = (counts == 2) & (np.linalg.norm(total, axis=1) > np.sqrt(2 + 2 * CREASE_COSINE))
    return ~flat[edge_ids].reshape(-1, 3)


def crease_distances(
    vertices: Array, faces: NDArray[np.int64], face_ids: NDArray[np.int64], points: Array
) -> tuple[Array, Array]:
    """Distance (N,) of points on faces to the nearest crease of their own face, and its direction.

    Distances are infinite without a crease; unit directions (N, 3) lie in the surface, across the crease.
    """
    creased = crease_edges(vertices, faces)[face_ids]
    normals, _ = face_normals_areas(vertices, faces)
    corners = vertices[faces[face_ids]]
    along = np.roll(corners, -1, 1) - corners
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-30)
    across = np.cross(normals[face_ids][:, None], along)
    distances = np.abs(np.einsum("nkd,nkd->nk", points[:, None] - corners, across))
    distances = np.where(creased, distances, np.inf)
    nearest = distances.argmin(1)
    rows = np.arange(len(points))
    return distances[rows, nearest], across[rows, nearest]
