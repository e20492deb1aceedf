"""Real spherical harmonics up to degree 3: evaluation and exact rotation."""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.values import Array


def sh_basis(directions: ArrayLike, degree: int) -> Array:
    """Compute the basis functions (N, (degree + 1)^2) at unit directions (N, 3).

    Signs and order are those of 3DGS files.

    Source: Ramamoorthi & Hanrahan 2001, with the Condon-Shortley phase.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    basis = [np.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
        basis += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e = (
            0.5900435899266435,
            2.890611442640554,
            0.4570457994644658,
            0.3731763325901154,
            1.445305721320277,
        )
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            d * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return np.stack(basis, -1)


def sphere_directions(count: int) -> Array:
    """Return evenly distributed unit directions (count, 3) on a golden spiral."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


def sh_rotation(R: ArrayLike, degree: int) -> list[Array]:
    """Compute the matrices (..., 2l + 1, 2l + 1), l = 1..degree, that rotate coefficients by R (..., 3, 3).

    The rotated function is `f'(R d) = f(d)`. Each band is computed exactly from a few sample directions, because the space
    that the basis functions of a band span is invariant under rotation.
    """
    R = np.asarray(R, np.float64)
    directions, solvers = _sample_bands(degree)
    turned = sh_basis(directions @ R, degree)  # basis at R^T d
    return [
        solver @ turned[..., band * band : (band + 1) ** 2] for band, solver in enumerate(solvers, start=1)
    ]


@cache
def _sample_bands(degree: int) -> tuple[Array, list[Array]]:
    """Return sample directions (32, 3), and the pseudo-inverse of each band's basis at these directions."""
    # The directions are fixed and in general position, and sufficient for a well-posed system of every band.
    directions = np.random.default_rng(7).normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    fixed = sh_basis(directions, degree)
    bands = [fixed[:, band * band : (band + 1) ** 2] for band in range(1, degree + 1)]
    return directions, [np.asarray(np.linalg.pinv(band), np.float64) for band in bands]


def rotate_sh(sh: NDArray[np.float32], R: ArrayLike) -> NDArray[np.float32]:
    """Rotate SH coefficients (N, K, 3) by R (3, 3)."""
    degree = int(np.sqrt(sh.shape[1])) - 1
    result = np.array(sh, np.float32)
    for band, matrix in enumerate(sh_rotation(R, degree), start=1):
        columns = slice(band * band, (band + 1) ** 2)
        result[:, columns] = np.matmul(matrix.astype(np.float32), sh[:, columns])
    return result
