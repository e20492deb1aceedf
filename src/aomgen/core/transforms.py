"""Rigid transforms, similarities and rotations as plain arrays.

All functions take and return float64 arrays; those whose docstrings name a "stack" broadcast over leading axes.
Quaternions are in the order w, x, y, z.
"""

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.values import Array

# Largest accepted deviation of a given rotation, see `measure_rigidity`; values rounded to four digits are accepted.
ROTATION_TOLERANCE = 1e-3


def transform(R: ArrayLike, t: ArrayLike) -> Array:
    """Build a stack of (4, 4) transforms from rotations (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(R, np.float64)
    t = np.asarray(t, np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def measure_rigidity(T: ArrayLike) -> tuple[float, float]:
    """Return the determinant of the upper left block R (3, 3) of a matrix (4, 4), and the largest entry of |R R^T - 1|."""
    R = np.asarray(T, np.float64)[:3, :3]
    return float(np.linalg.det(R)), float(np.abs(R @ R.T - np.eye(3)).max())


def invert(T: ArrayLike) -> Array:
    """Invert a stack of rigid transforms (..., 4, 4)."""
    T = np.asarray(T, np.float64)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_inverse, -np.einsum("...ij,...j->...i", R_inverse, T[..., :3, 3]))


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Transform points (..., 3) by one transform or similarity (4, 4), or by a stack that broadcasts with them."""
    T = np.asarray(T, np.float64)
    return np.einsum("...ij,...j->...i", T[..., :3, :3], np.asarray(points, np.float64)) + T[..., :3, 3]


def similarity(scale: float, R: ArrayLike, t: ArrayLike) -> Array:
    """Build the similarity (4, 4) `p_to = scale * R @ p_from + t`."""
    return transform(scale * np.asarray(R, np.float64), t)


def similarity_parts(S: ArrayLike) -> tuple[float, Array, Array]:
    """Split a similarity (4, 4) into scale, rotation (3, 3) and translation (3,)."""
    S = np.asarray(S, np.float64)
    scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
    return scale, S[:3, :3] / scale, S[:3, 3].copy()


def matrix_from_rotvec(rotvecs: ArrayLike) -> Array:
    """Convert rotation vectors (axis times angle) (..., 3), [rad], to rotations (..., 3, 3). Source: Rodrigues' formula."""
    rotvecs = np.asarray(rotvecs, np.float64)
    angles = np.linalg.norm(rotvecs, axis=-1)[..., None, None]
    K = skew(rotvecs)
    # np.sinc(x) = sin(pi x) / (pi x) is smooth at zero, so no special case is needed.
    first = np.sinc(angles / np.pi)
    second = 0.5 * np.sinc(angles / (2 * np.pi)) ** 2
    return np.eye(3) + first * K + second * (K @ K)


def rotvec_from_matrix(R: ArrayLike) -> Array:
    """Convert rotations (..., 3, 3) to rotation vectors (axis times angle) (..., 3), [rad], with angles in 0..pi."""
    quats = quat_from_matrix(R)
    quats = np.where(quats[..., :1] < 0, -quats, quats)
    sines = np.linalg.norm(quats[..., 1:], axis=-1, keepdims=True)
    angles = 2 * np.arctan2(sines, quats[..., :1])
    return quats[..., 1:] * np.where(sines > 1e-12, angles / np.maximum(sines, 1e-12), 2.0)


def skew(vectors: ArrayLike) -> Array:
    """Build cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    v = np.asarray(vectors, np.float64)
    K = np.zeros((*v.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return K - np.swapaxes(K, -1, -2)


def cross(a: Array, b: Array) -> Array:
    """Compute cross products (..., 3); for few vectors several times faster than numpy's."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def make_tangent_basis(axis: Array) -> Array:
    """Compute two unit vectors (2, 3) that complete a unit vector (3,) to a right-handed frame."""
    first = cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    return np.stack([first, cross(axis, first)])


def matrix_from_quat(quats_wxyz: ArrayLike) -> Array:
    """Convert quaternions (..., 4), which need not be normalized, to rotations (..., 3, 3)."""
    q = np.asarray(quats_wxyz, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_from_matrix(R: ArrayLike) -> Array:
    """Convert rotations (..., 3, 3) to unit quaternions (..., 4). Source: Shepperd, 1978."""
    R = np.asarray(R, np.float64)
    m = R.reshape(-1, 3, 3)
    trace = np.trace(m, axis1=1, axis2=2)
    candidates = np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], 1)
    largest = np.argmax(candidates, 1)
    quats = np.empty((len(m), 4))
    quats[:, 0] = 1 + trace
    quats[:, 1:] = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rows = largest == i + 1
        q = quats[rows]
        a = m[rows]
        q[:, 0] = a[:, k, j] - a[:, j, k]
        q[:, 1 + i] = 1 + a[:, i, i] - a[:, j, j] - a[:, k, k]
        q[:, 1 + j] = a[:, i, j] + a[:, j, i]
        q[:, 1 + k] = a[:, i, k] + a[:, k, i]
        quats[rows] = q
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats.reshape(*R.shape[:-2], 4)


def quat_multiply(a_wxyz: ArrayLike, b_wxyz: ArrayLike) -> Array:
    """Multiply quaternions (..., 4); the product is the rotation by b followed by that by a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a_wxyz, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b_wxyz, np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def interpolate(T_a: ArrayLike, T_b: ArrayLike, shares: ArrayLike) -> Array:
    """Interpolate transforms: positions linearly, rotations along the shortest path. The arguments broadcast.

    Args:
        T_a: Transforms (..., 4, 4) at share 0.
        T_b: Transforms (..., 4, 4) at share 1, between the same frames.
        shares: Interpolation parameters (...), 0..1.
    """
    T_a, T_b = np.asarray(T_a, np.float64), np.asarray(T_b, np.float64)
    shares = np.asarray(shares, np.float64)
    turn = rotvec_from_matrix(T_b[..., :3, :3] @ np.swapaxes(T_a[..., :3, :3], -1, -2))
    R = matrix_from_rotvec(shares[..., None] * turn) @ T_a[..., :3, :3]
    return transform(R, (1 - shares)[..., None] * T_a[..., :3, 3] + shares[..., None] * T_b[..., :3, 3])


def path_steps(Ts: Array, turn_weight_m: float) -> Array:
    """Compute the step lengths (..., K - 1) along paths (..., K, 4, 4), [m]; a rotation of 1 rad counts as `turn_weight_m`."""
    ways = np.linalg.norm(np.diff(Ts[..., :3, 3], axis=-2), axis=-1)
    # The Frobenius norm of the difference of two rotations, sqrt(8) sin(angle / 2), is sqrt(2) times a small angle.
    chords = np.linalg.norm(np.diff(Ts[..., :3, :3], axis=-3), axis=(-2, -1)) / np.sqrt(2)
    return np.asarray(ways + turn_weight_m * chords)


def angle_between(a: ArrayLike, b: ArrayLike) -> float:
    """Compute the angle between two vectors (3,), [rad], which is accurate near 0 and pi as well."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
