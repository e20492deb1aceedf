"""Rigid registration of two point clouds by closest points, with a kernel that forgets outliers."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.transforms import apply, rotvec_from_matrix, transform
from aomgen.core.values import Array, Matrix4, freeze_arrays

# Closest-point steps at one kernel width at most; they end earlier where nothing moves.
_STEPS = 40
# Motions smaller than these change nothing that is reported.
_SETTLED_M, _SETTLED_RAD = 1e-5, 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidFit:
    """Where the source lies on the target.

    Attributes:
        T_target_source: Rigid motion (4, 4).
        matched: Share of the source within the kernel of the target.
        rms_m: Of the distances of that share, [m]; infinite when nothing matched.
    """

    T_target_source: Matrix4
    matched: float
    rms_m: float

    __post_init__ = freeze_arrays


def rigid_icp(source: Array, target: Array, T_start: Array, kernel_m: float) -> RigidFit:
    """Move the source onto the target, each point towards the nearest one, without changing its size.

    Args:
        source: Points (N, 3), [m].
        target: Points (M, 3), [m], denser than `kernel_m`.
        T_start: First guess T_target_source (4, 4).
        kernel_m: Distances well beyond this do not count in the end.

    Source: Zhang, Yao and Deng, "Fast and Robust Iterative Closest Point", PAMI 2021 (Welsch's
    function, its width halved from coarse to fine; without their acceleration). Not checked: that
    the start leads to the right of several places.
    """
    tree = cKDTree(target)
    T = np.asarray(T_start, np.float64)
    distances = tree.query(apply(T, source))[0]
    width = max(3 * float(np.median(distances)), kernel_m)
    while True:
        for _ in range(_STEPS):
            moved = apply(T, source)
            distances, nearest = tree.query(moved)
            step = weighted_rigid(moved, target[nearest], np.exp(-0.5 * (distances / width) ** 2))
            T = step @ T
            turn = np.linalg.norm(rotvec_from_matrix(step[:3, :3]))
            shift = np.linalg.norm(apply(step, moved.mean(0)) - moved.mean(0))
            if shift < _SETTLED_M and turn < _SETTLED_RAD:
                break
        if width <= kernel_m:
            break
        width = max(width / 2, kernel_m)
    distances = tree.query(apply(T, source))[0]
    near = distances < 2 * kernel_m
    rms = float(np.sqrt(np.mean(distances[near] ** 2))) if near.any() else float("inf")
    return RigidFit(T_target_source=T, matched=float(near.mean()), rms_m=rms)


def weighted_rigid(source: Array, target: Array, weights: Array) -> Array:
    """Rigid motion (4, 4) that carries points (N, 3) onto others in weighted least squares.

    Source: Kabsch, 1976. Weights (N,) that are all zero leave the points where they are.
    """
    total = float(weights.sum())
    if not total > 1e-12:
        return np.eye(4)
    share = weights / total
    middle_source, middle_target = share @ source, share @ target
    covariance = (target - middle_target).T @ (share[:, None] * (source - middle_source))
    U, _, Vt = np.linalg.svd(covariance)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ mirror @ Vt
    return transform(R, middle_target - R @ middle_source)
