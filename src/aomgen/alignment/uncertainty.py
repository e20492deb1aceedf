"""Covariance of an alignment, of its joint values, and of its camera poses.

Errors of neighboring contour points are correlated, and so are those of neighboring views. Therefore the number of points is no
measure of the information, and groups of neighboring views are left out in turn (jackknife). Errors of neighboring cameras are
correlated, because they observe the same points, so averaging over many views reduces them little. Source: Triggs et al.,
"Bundle adjustment - a modern synthesis", 2000, sec. 6 (reduced camera system) and 9 (gauge).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix, csr_matrix

from aomgen.alignment.confidence import ViewEvidence
from aomgen.alignment.silhouette_fit import EDGE_KERNEL
from aomgen.core.camera import Camera
from aomgen.core.least_squares import Kernel, ResidualTerm, add, jackknife_covariance, solve
from aomgen.core.transforms import similarity_parts, skew
from aomgen.core.values import Array, freeze_arrays

# Groups of views, or segments of a video, left out in turn (jackknife): the rest must still determine all joints.
JACKKNIFE_GROUPS = 8
# Largest offset of a revolute joint [rad] and of a prismatic joint [m] of a calibrated arm.
MAX_JOINT_OFFSET_RAD, MAX_JOINT_OFFSET_M = float(np.radians(2.0)), 0.005
# Standard deviations of a significant deviation: four, because many quantities are tested.
SIGNIFICANT_SDS = 4.0
# Standard deviations of a wide prior of joint offsets, [rad] and [m]; encoders of arms are accurate to a fraction of a degree.
JOINT_PRIOR_RAD, JOINT_PRIOR_M = float(np.radians(20.0)), 0.1
# Mean length of a normally distributed error in a plane over its standard deviation along one axis.
_RAYLEIGH = float(np.sqrt(np.pi / 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraErrors:
    """Joint covariance of camera poses.

    Attributes:
        covariance: (6 N, 6 N), for each camera the center, then the rotation vector [rad], in the axes and units of a frame.
    """

    names: tuple[str, ...]
    covariance: Annotated[Array, "E E"]

    __post_init__ = freeze_arrays

    def view_from(self, S_other_frame: Array) -> "CameraErrors":
        """Transform the errors to the axes and units of another frame."""
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
    """Compute the covariance (6 N, 6 N) of the poses of N cameras: for each the center, then the rotation vector.

    The errors remain after the similarity that fits the camera centers best, because a structure has no absolute position,
    orientation and scale.

    Args:
        cameras: In any frame; lengths of the result are in its unit.
        observations: (M, 2) rows of (point, camera).

    Not checked: intrinsics are taken as exact, and the errors of the points are independent.
    """
    point, camera = observations[:, 0].astype(np.int64), observations[:, 1].astype(np.int64)
    J_point, J_camera = _jacobians(cameras, points, point, camera)
    # All observations of one point show the same patch, and the detector has the same error in all of them. Together they have
    # the information of one observation.
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
    reduced = block_diag(*U) - csr_matrix(W @ solved @ W.T).toarray()
    sigma = error_px / _RAYLEIGH
    P = _gauge_projection(np.array([c.center for c in cameras]))
    return sigma**2 * P @ _pseudo_inverse(reduced) @ P.T


def _jacobians(
    cameras: list[Camera], points: Array, point: NDArray[np.int64], camera: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Compute the change of every observation with its point (M, 2, 3) and its camera's pose (M, 2, 6)."""
    J_point, J_camera = np.empty((len(point), 2, 3)), np.empty((len(point), 2, 6))
    for index, one in enumerate(cameras):
        own = camera == index
        seen = points[point[own]]
        J_point[own] = one.projection_slopes(seen)
        J_camera[own] = np.concatenate([-J_point[own], J_point[own] @ skew(seen - one.center)], 2)
    return J_point, J_camera


def _pseudo_inverse(reduced: Array) -> Array:
    """Invert a matrix on the complement of the seven directions that no image determines."""
    scaling = 1 / np.sqrt(np.maximum(np.diag(reduced), 1e-12))
    values, vectors = np.linalg.eigh(reduced * scaling[:, None] * scaling)
    kept = vectors[:, 7:]
    inverse = kept / np.maximum(values[7:], 1e-12 * values[-1]) @ kept.T
    return inverse * scaling[:, None] * scaling


def _gauge_projection(centers: Array) -> Array:
    """Return the projection that removes from pose errors (6 N,) the similarity that fits the errors of the centers best."""
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


def similarity_covariance(evidence: list[ViewEvidence]) -> Array:
    """Compute the covariance (7, 7) of rotation vector [rad], end effector [m] and log scale.

    The covariance is infinite with fewer than three views. Not checked: errors that all views share; see
    `covariance_from_cameras`.
    """
    return _jackknife(evidence, _similarity_step)


def covariance_from_cameras(evidence: list[ViewEvidence], errors: CameraErrors) -> Array:
    """Compute the covariance (7, 7) caused by errors of the cameras; parameters as in `similarity_covariance`.

    The covariance is scaled up if the outlines of single views deviate by more than the cameras' covariance predicts.

    Args:
        errors: Uncertainties of the cameras, world frame; other views are treated as exact.
    """
    rows = {name: slice(6 * index, 6 * index + 6) for index, name in enumerate(errors.names)}
    H, K = np.zeros((7, 7)), np.zeros((7, len(errors.covariance)))
    seen, expected = [], []
    for view in evidence:
        weighted = view.jacobian.T * view.edge_weights
        H += weighted @ view.jacobian
        if view.name in rows:
            own = rows[view.name]
            K[:, own] = weighted @ view.camera_jacobian
            pull = view.normals.T * view.edge_weights
            shift = np.linalg.pinv(pull @ view.normals) @ pull
            move = shift @ view.camera_jacobian
            seen.append(float(np.sum((shift @ view.edge_px) ** 2)))
            expected.append(float(np.trace(move @ errors.covariance[own, own] @ move.T)))
    if not seen:
        return np.zeros((7, 7))
    # The median of the sum of two squares of normal errors is ln 2 times its mean.
    ratio = np.median(np.array(seen) / np.maximum(expected, 1e-12)) / np.log(2)
    K = np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(7), K)
    return np.asarray(max(1.0, float(ratio)) * K @ errors.covariance @ K.T, np.float64)


def joint_offset_limits(slides: NDArray[np.bool_]) -> Array:
    """Return the largest offset (J,) of each joint of a calibrated arm, [rad], or [m] for a prismatic joint."""
    return np.where(slides, MAX_JOINT_OFFSET_M, MAX_JOINT_OFFSET_RAD)


def message_unit(slides: bool) -> tuple[float, str]:
    """Return the unit of joint offsets in messages, mm or deg, preceded by its number in one m or rad."""
    return (1e3, "mm") if slides else (float(np.degrees(1.0)), "deg")


def joint_offsets(evidence: list[ViewEvidence], slides: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Estimate joint offsets from at least one view.

    Joints and similarity are estimated together, linearized about the rendered state, so offsets of more than about ten degrees
    are only detected as large.

    Args:
        slides: Mask (J,) of the prismatic joints.

    Returns:
        Offsets (J,) and their standard deviations (J,), [rad], or [m] for a prismatic joint; and the root mean square (J,),
        [px], of the motion of the outline by each offset that no motion of the whole robot explains; it is nearly zero for a
        rotation about the axis of a round base.
    """
    step = partial(_joint_step, prior_sds=np.where(slides, JOINT_PRIOR_M, JOINT_PRIOR_RAD))
    offsets = step(evidence)[7:]
    covariance = _jackknife(evidence, step, 7 + len(offsets))
    weights, whole, own = (
        _pool(evidence, field) for field in ("border_weights", "jacobian", "joint_jacobian")
    )
    same = np.linalg.lstsq(np.sqrt(weights)[:, None] * whole, np.sqrt(weights)[:, None] * own, rcond=None)[0]
    left = own - whole @ same
    moves_px = np.abs(offsets) * np.sqrt(weights @ left**2 / weights.sum())
    return offsets, np.sqrt(np.diag(covariance)[7:]), moves_px


def _jackknife(
    evidence: list[ViewEvidence], step: Callable[[list[ViewEvidence]], Array], size: int = 7
) -> Array:
    groups = min(JACKKNIFE_GROUPS, len(evidence))
    if groups < 3:
        return np.diag(np.full(size, np.inf))
    member = np.arange(len(evidence)) * groups // len(evidence)
    rest = [[evidence[view] for view in np.flatnonzero(member != group)] for group in range(groups)]
    return jackknife_covariance(np.stack([step(views) for views in rest]))


def _similarity_step(evidence: list[ViewEvidence]) -> Array:
    """Step (7,) to the robust optimum of the edges, from the rendered pose."""
    J, shifts = _pool(evidence, "jacobian"), _pool(evidence, "edge_px")
    weights = _pool(evidence, "edge_weights") / EDGE_KERNEL.weights(shifts)
    return _solve([_shifts_term(J, shifts, weights, EDGE_KERNEL)], J.shape[1])


def _joint_step(evidence: list[ViewEvidence], prior_sds: Array) -> Array:
    """Step (7 + J,) of similarity and joints to the color borders; `prior_sds` (J,) in the units of the joints."""
    J = np.concatenate([_pool(evidence, "jacobian"), _pool(evidence, "joint_jacobian")], axis=1)
    borders = _shifts_term(J, _pool(evidence, "border_px"), _pool(evidence, "border_weights"))
    prior: ResidualTerm[Array] = ResidualTerm(
        name="joints", residual=lambda x: x[7:], sd=prior_sds, jacobian=lambda x: np.eye(len(x))[7:]
    )
    return _solve([borders, prior], J.shape[1])


def _pool(evidence: list[ViewEvidence], field: str) -> Array:
    return np.concatenate([getattr(view, field) for view in evidence])


def _shifts_term(
    J: Array, shifts: Array, weights: Array, kernel: Kernel | None = None
) -> ResidualTerm[Array]:
    return ResidualTerm(
        name="shifts",
        residual=lambda x: J @ x - shifts,
        sd=1 / np.sqrt(np.maximum(weights, 1e-12)),
        kernel=kernel,
        jacobian=lambda x: J,
    )


def _solve(terms: list[ResidualTerm[Array]], dimension: int) -> Array:
    return solve(terms, np.zeros(dimension), retract=add, dimension=dimension, max_iterations=10).state
