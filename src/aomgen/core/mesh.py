"""Triangle meshes with an optional texture."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.transforms import apply
from aomgen.core.values import Array, Vector3, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """Triangles, seen from both sides, with one material.

    Attributes:
        name: Name inside its link.
        vertices: (V, 3), [m].
        faces: (F, 3) vertex indices.
        uvs: Texture coordinates of the face corners (F, 3, 2), v up; empty (0, 3, 2) without.
        texture_srgb: (H, W, 3) uint8; empty (0, 0, 3) without, then `color_srgb` holds.
        color_srgb: Base color (3,), 0..1.
        roughness, metallic: UsdPreviewSurface's parameters, 0..1.
    """

    name: str
    vertices: Annotated[Array, "_ 3"]
    faces: Annotated[NDArray[np.int64], "_ 3"]
    uvs: Annotated[Array, "_ 3 2"]
    texture_srgb: Annotated[NDArray[np.uint8], "_ _ 3"]
    color_srgb: Vector3
    roughness: float = 0.6
    metallic: float = 0.0

    __post_init__ = freeze_arrays

    def transformed(self, S: ArrayLike) -> "Mesh":
        """Moved by a rigid transform or a similarity (4, 4)."""
        return Mesh(
            name=self.name,
            vertices=apply(S, self.vertices),
            faces=self.faces,
            uvs=self.uvs,
            texture_srgb=self.texture_srgb,
            color_srgb=self.color_srgb,
            roughness=self.roughness,
            metallic=self.metallic,
        )


def face_normals_areas(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, Array]:
    """Unit normals (F, 3) and areas (F,), [m^2]; a degenerate face has normal 0."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    lengths = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(lengths, 1e-30)[:, None], 0.5 * lengths


def sample_surface(
    vertices: Array, faces: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64], Array]:
    """Points spread evenly by area over a surface.

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
