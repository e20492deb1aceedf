"""Joint covariance of the camera poses of a structure, from its bundle adjustment.

Errors of neighbouring cameras are correlated, since they see the same points; an alignment that rests
on many views averages little of them away. Source: Triggs et al., "Bundle adjustment - a modern
synthesis", 2000, sec. 6 (reduced camera system) and 9 (gauge).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csr_matrix

from aomgen.core.camera import Camera
from aomgen.core.transforms import similarity_parts, skew
from aomgen.core.values import Array, freeze

# The mean length of a plane normal error over its deviation along one axis.
_RAYLEIGH = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraErrors:
    """Joint covariance of camera poses.

    Attributes:
        names: Of N cameras.
        covariance: (6 N, 6 N), of each camera's centre, then its rotation vector [rad], in the axes
            and units of a frame.
    """

    names: tuple[str, ...]
    covariance: Array

    def __post_init__(self) -> None:
        freeze(self, "covariance", self.covariance, (6 * len(self.names),) * 2)

    def seen_from(self, S_other_frame: Array) -> "CameraErrors":
        """The same errors in the axes and units of another frame."""
        scale, R, _ = similarity_parts(S_other_frame)
        one = np.zeros((6, 6))
        one[:3, :3], one[3:, 3:] = scale * R, R
        count = len(self.names)
        blocks = self.covariance.reshape(count, 6, count, 6)
        turned = np.einsum("ik,akbl,jl->aibj", one, blocks, one, optimize=True)
        return CameraErrors(names=self.names, covariance=turned.reshape(self.covariance.shape))


def camera_covariance(
    cameras: list[Camera], points: Array, observations: NDArray[np.int32], error_px: float
) -> Array:
    """Covariance (6 N, 6 N) of the poses of N cameras: centre, then rotation vector, for each.

    Errors are counted after the similarity that fits the camera centres best: a
    structure has no position, direction and size of its own.

    Args:
        cameras: In any frame; lengths of the result are in its unit.
        points: (P, 3), same frame.
        observations: (M, 2) rows of (point, camera).
        error_px: Mean reprojection error.

    Not checked: intrinsics are taken as exact, and every point errs for itself.
    """
    point, camera = observations[:, 0].astype(np.int64), observations[:, 1].astype(np.int64)
    J_point, J_camera = _jacobians(cameras, points, point, camera)
    # Sightings of one point are of one patch, whose corner a detector misses in the same way: all
    # of them together say as much as one.
    share = 1 / np.sqrt(np.bincount(point, minlength=len(points))[point])[:, None, None]
    J_point, J_camera = share * J_point, share * J_camera
    U = np.zeros((len(cameras), 6, 6))
    np.add.at(U, camera, np.einsum("mki,mkj->mij", J_camera, J_camera))
    V = np.zeros((len(points), 3, 3))
    np.add.at(V, point, np.einsum("mki,mkj->mij", J_point, J_point))
    V += 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    order = np.lexsort((point, camera))
    starts = np.searchsorted(camera[order], np.arange(len(cameras) + 1))
    blocks = np.einsum("mki,mkj->mij", J_camera, J_point)[order]
    W = bsr_matrix((blocks, point[order], starts), shape=(6 * len(cameras), 3 * len(points)))
    solved = bsr_matrix(
        (np.linalg.inv(V), np.arange(len(points)), np.arange(len(points) + 1)), shape=(3 * len(points),) * 2
    )
    reduced = -csr_matrix(W @ solved @ W.T).toarray()
    for index in range(len(cameras)):
        rows = slice(6 * index, 6 * index + 6)
        reduced[rows, rows] += U[index]
    sigma = error_px / _RAYLEIGH
    P = _gauge_projection(np.array([c.center for c in cameras]))
    return sigma**2 * P @ _pseudo_inverse(reduced) @ P.T


def _jacobians(
    cameras: list[Camera], points: Array, point: NDArray[np.int64], camera: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Change of every observation with its point (M, 2, 3) and its camera's pose (M, 2, 6)."""
    Rs = np.array([c.T_world_cam[:3, :3].T for c in cameras])[camera]
    arms = points[point] - np.array([c.center for c in cameras])[camera]
    x, y, z = np.moveaxis(np.einsum("mij,mj->mi", Rs, arms), 1, 0)
    fx = np.array([c.fx for c in cameras])[camera]
    fy = np.array([c.fy for c in cameras])[camera]
    zero = np.zeros_like(z)
    J = np.stack(
        [np.stack([fx / z, zero, -fx * x / z**2], 1), np.stack([zero, fy / z, -fy * y / z**2], 1)], 1
    )
    J_point = J @ Rs
    return J_point, np.concatenate([-J_point, J_point @ skew(arms)], 2)


def _pseudo_inverse(reduced: Array) -> Array:
    """Inverse on everything but the seven directions that no image fixes."""
    scaling = 1 / np.sqrt(np.maximum(np.diag(reduced), 1e-12))
    values, vectors = np.linalg.eigh(reduced * scaling[:, None] * scaling)
    kept = vectors[:, 7:]
    inverse = kept / np.maximum(values[7:], 1e-12 * values[-1]) @ kept.T
    return inverse * scaling[:, None] * scaling


def _gauge_projection(centers: Array) -> Array:
    """Takes from pose errors (6 N,) the similarity that explains their centres best."""
    count = len(centers)
    arms = centers - centers.mean(0)
    motions = np.zeros((count, 6, 7))
    motions[:, :3, :3] = np.eye(3)
    motions[:, :3, 3:6] = -skew(arms)
    motions[:, :3, 6] = arms
    motions[:, 3:, 3:6] = np.eye(3)
    G = motions.reshape(6 * count, 7)
    seen = motions.copy()
    seen[:, 3:] = 0
    return np.eye(6 * count) - G @ np.linalg.pinv(seen.reshape(6 * count, 7))
