"""Conversion of meshes to Gaussians: flat discs (surfels) that are distributed evenly over the surface.

A disc stores its normal, its albedo and its transfer (`core.light`), so that it can be relit in any pose.
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

# Number of candidates for each disc; more candidates give a more even distribution.
OVERSAMPLING: Final = 5
# The density of a Poisson-disc set of radius r is approximately DISC_DENSITY / r^2.
DISC_DENSITY: Final = 0.7
# Ratio of a disc's standard deviation to its radius, large enough that neighboring discs leave no gaps.
SPREAD: Final = 0.87
# Ratio of a disc's thickness to its radius.
THICKNESS: Final = 0.05
# Opacity of opaque discs, the largest alpha of one Gaussian in the engine.
OPACITY: Final = 0.99
# A surface of more than HIDES opacity blocks light; candidates of at most UNSEEN opacity are removed.
HIDES, UNSEEN = 0.5, 0.02
# Factor on the radius of discs where the texture changes or a crease is near.
FINER: Final = 0.5
# Difference of sRGB values between fine and coarse samples of the texture above which a point has detail.
DETAIL: Final = 0.04
# Absolute cosine between normals above which two surfaces are parallel.
PARALLEL: Final = 0.98
# Cosine of the angle between the normals of two faces above which their common edge is not a crease.
CREASE_COSINE = float(np.cos(np.deg2rad(30.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Surfels:
    """N discs of one link, in the frame of its meshes.

    Attributes:
        gaussians: Gaussians with the albedo as color and the opacity of the meshes.
        normals: Outward unit normals (N, 3).
        bends: Tangential offsets (N, 3) of the normals by normal maps.
        albedo_linear: Linear albedo (N, 3), 0..1.
        transfer: Transfer (N, 9), see `core.light`.
        roughness, metallic: Material parameters (N,), 0..1.
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
        """Unit normals (N, 3) for shading, including normal maps."""
        return bend_normals(self.normals, self.bends)


@dataclass(frozen=True, slots=True)
class _Candidates:
    """N points on the surface, from which the discs are chosen."""

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
    """Cover the meshes of one rigid link with about `count` discs, up to a third more or less.

    The transfer is that of unoccluded discs. `oversampling` is the number of candidates for each disc.

    Raises:
        AssetError: The meshes have no surface, or are completely transparent.

    Not checked: the orientation of the triangles, which determines the direction of the normals.
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
    # Meshes are thinned separately, so that the discs of a sticker are not replaced by those of the wall behind it.
    chosen = [_thin(part, radius, rng) for part in parts]
    return _discs(_join([part for part, _ in chosen]), np.concatenate([radii for _, radii in chosen]))


def hiding_points(meshes: Sequence[Mesh], count: int, rng: np.random.Generator) -> Array:
    """Sample points (M, 3) uniformly on surfaces that block light, or on all surfaces if none blocks it.

    `count` is the number of points on all surfaces, before transparent ones are removed.
    """
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
    # Twice as many points are sampled, because the finer discs need more candidates.
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
    """Compute tangential offsets (N, 3) of the normals by the normal map, of length at most 1; zero without a map."""
    if NORMAL_MAP not in mesh.maps:
        return np.zeros((len(face_ids), 3))
    local = 2 * _sample(mesh, face_ids, weights, footprint, mesh.maps[NORMAL_MAP], [0.5, 0.5, 1.0]) - 1
    local /= np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-6)
    edges = np.diff(mesh.vertices[mesh.faces[face_ids]], axis=1)
    steps = np.diff(mesh.uvs[face_ids], axis=1)
    # The columns are the spatial directions of the texture coordinates u and v.
    along = np.einsum("nkd,nkc->ndc", edges, np.linalg.pinv(steps).transpose(0, 2, 1))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.einsum("ndc,nc->nd", along, local[:, :2])


def bend_normals(normals: NDArray[np.floating], bends: NDArray[np.floating]) -> NDArray[np.floating]:
    """Compute the unit normals (N, 3) that result from `normals` (N, 3) and tangential offsets `bends` (N, 3)."""
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
    """Sample an image at points on faces (N, C), 0..1, averaged over about `footprint` [m]; without image, repeat a value."""
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
    """Interpolate texture values (N, C) at uv (N, 2), v up; the texture repeats outside 0..1."""
    height, width = texture.shape[:2]
    inside = np.where((uv < 0) | (uv > 1), uv - np.floor(uv), uv)
    places = np.stack([(1 - inside[:, 1]) * height - 0.5, inside[:, 0] * width - 0.5])
    channels = [
        map_coordinates(texture[..., k], places, order=1, mode="nearest") for k in range(texture.shape[2])
    ]
    return np.stack(channels, 1)


def _select_uncovered(parts: list[_Candidates], radius: float) -> list[_Candidates]:
    """Remove candidates that a parallel surface of another mesh covers closely, for example a wall behind a sticker.

    Nearly coincident discs would be blended in an order that depends on the view.
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
    """Select candidates whose distance is at least their radius; return them and the radii, [m]."""
    kept = []
    for fine, reach in ((True, radius * FINER), (False, radius)):
        members = np.flatnonzero(part.fine == fine)
        if len(members):
            # The normal is part of the position, so that both sides of a thin sheet are kept.
            places = np.column_stack([part.points[members], part.normals[members] * reach])
            kept.append(members[_poisson_discs(places, reach, rng)])
    selected = part.select(np.concatenate(kept))
    return selected, np.where(selected.fine, radius * FINER, radius)


def _poisson_discs(places: Array, reach: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the indices of a maximal set of points with pairwise distance > reach, chosen in random order."""
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
    """Build Gaussians with axes along the nearest crease, across it, and along the normal."""
    across = kept.crease_directions
    R = np.stack([np.cross(across, kept.normals), across, kept.normals], -1)
    # Near a crease, the width of a disc is limited to the distance from it, so that outlines are sharp.
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
    """Return a mask (F, 3) of the edges that are creases or borders; edge k joins the corners k and k + 1.

    Vertices at the same position count as one, because exporters duplicate them at seams.
    """
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    _, merged = np.unique(np.round(vertices / (size * 1e-6)).astype(np.int64), axis=0, return_inverse=True)
    corners = merged.reshape(-1)[faces]
    pairs = np.sort(np.stack([corners, np.roll(corners, -1, 1)], -1).reshape(-1, 2), 1)
    _, edge_ids, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    edge_ids = edge_ids.reshape(-1)
    normals, _ = face_normals_areas(vertices, faces)
    owners = np.repeat(np.arange(len(faces)), 3)
    # The length of the sum of two unit normals at an edge is a function of the angle between them.
    total = np.zeros((len(counts), 3))
    np.add.at(total, edge_ids, normals[owners])
    flat = (counts == 2) & (np.linalg.norm(total, axis=1) > np.sqrt(2 + 2 * CREASE_COSINE))
    return ~flat[edge_ids].reshape(-1, 3)


def crease_distances(
    vertices: Array, faces: NDArray[np.int64], face_ids: NDArray[np.int64], points: Array
) -> tuple[Array, Array]:
    """Compute distances (N,), [m], of points (N, 3) on faces from the nearest crease of their face, and directions (N, 3).

    Distances are infinite if the face has no crease. Directions are unit vectors in the face, perpendicular to the crease.
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
