"""Triangle meshes with an optional texture and maps of other material parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.transforms import apply
from aomgen.core.values import Array, Vector3, freeze_arrays

# Material parameters that a map of the same name may replace, and the name of the tangent-space normal map.
NUMBERS: Final = ("opacity", "roughness", "metallic")
NORMAL_MAP: Final = "normal"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """Double-sided triangles with one material.

    Attributes:
        name: Name within its link.
        vertices: Vertices (V, 3), [m].
        faces: Vertex indices (F, 3).
        uvs: Texture coordinates of the face corners (F, 3, 2), v up; empty (0, 3, 2) without texture and maps.
        texture_srgb: Color texture (H, W, 3) uint8; if it is empty (0, 0, 3), `color_srgb` is used.
        color_srgb: Base color (3,), 0..1.
        roughness, metallic, opacity: Parameters of UsdPreviewSurface, 0..1; the mean if there is a map.
        maps: uint8 images by name: (H, W) for `NUMBERS`, (H, W, 3) for `NORMAL_MAP`, which holds (normal + 1) / 2.
    """

    name: str
    vertices: Annotated[Array, "_ 3"]
    faces: Annotated[NDArray[np.int64], "_ 3"]
    uvs: Annotated[Array, "_ 3 2"]
    texture_srgb: Annotated[NDArray[np.uint8], "_ _ 3"]
    color_srgb: Vector3
    roughness: float = 0.6
    metallic: float = 0.0
    opacity: float = 1.0
    maps: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze_arrays(self)
        for image in self.maps.values():
            image.flags.writeable = False

    @property
    def see_through(self) -> bool:
        """True if the material is partly transparent."""
        return self.opacity < 1

    def transform(self, S: ArrayLike) -> "Mesh":
        """Transform the mesh by a rigid transform or a similarity (4, 4)."""
        return replace(self, vertices=apply(S, self.vertices))


def face_normals_areas(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, Array]:
    """Compute the unit normals (F, 3) and areas (F,), [m^2], of faces; a degenerate face has the normal 0."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    lengths = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(lengths, 1e-30)[:, None], 0.5 * lengths


def sample_triangles(corners: Array, count: int, rng: np.random.Generator) -> Array:
    """Sample points (count, 3) uniformly by area over triangles (F, 3, 3)."""
    return sample_surface(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), count, rng)[0]


def sample_surface(
    vertices: Array, faces: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64], Array]:
    """Sample points uniformly by area over a surface.

    Args:
        vertices: Vertices (V, 3), [m].
        faces: Vertex indices of triangles (F, 3).
        count: Number of points.
        rng: Generator of the points.

    Returns:
        Points (count, 3), their faces (count,), and barycentric weights (count, 3).
    """
    _, areas = face_normals_areas(vertices, faces)
    face_ids = rng.choice(len(faces), count, p=areas / areas.sum())
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    points = np.einsum("nk,nkd->nd", weights, vertices[faces[face_ids]])
    return points, face_ids, weights


def sample_meshes(meshes: Sequence[Mesh], count: int, rng: np.random.Generator) -> Array:
    """Sample about `count` points (N, 3), the same number on each mesh, uniformly by area."""
    share = max(count // len(meshes), 100)
    return np.concatenate([sample_surface(mesh.vertices, mesh.faces, share, rng)[0] for mesh in meshes])
