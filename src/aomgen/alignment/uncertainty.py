"""Covariance of an alignment and of the joint values it assumes.

Errors of neighbouring contour points are correlated, and so are those of neighbouring views. The
number of points therefore carries no information: groups of neighbouring views are left out in turn (jackknife).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aomgen.alignment.camera_uncertainty import CameraErrors
from aomgen.alignment.confidence import ViewEvidence
from aomgen.core.values import Array, freeze

# Groups of views left out in turn (jackknife): each must still determine all joints.
GROUPS = 8
# Arms report their joints to a fraction of a degree; offsets beyond this are not expected at all.
JOINT_PRIOR_RAD = np.radians(20.0)


def similarity_covariance(evidence: list[ViewEvidence]) -> Array:
    """Covariance (7, 7) of rotation vector [rad], end effector [m] and log scale.

    Infinite when fewer than three views say anything. Not checked: errors that all views share;
    see `covariance_from_cameras`.
    """
    return _jackknife(evidence, _similarity_step)


def covariance_from_cameras(evidence: list[ViewEvidence], errors: CameraErrors) -> Array:
    """Covariance (7, 7) that errors of the cameras cause; parameters as `similarity_covariance`.

    Where the outlines of single views are off by more than the cameras' covariance expects, it is
    scaled up.

    Args:
        evidence: Of the aligned robot.
        errors: Of the cameras, world frame; views that are not among them are taken as exact.
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
    # The median of a sum of two squares is ln 2 of its mean.
    ratio = np.median(np.array(seen) / np.maximum(expected, 1e-12)) / np.log(2)
    K = np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(7), K)
    return np.asarray(max(1.0, float(ratio)) * K @ errors.covariance @ K.T, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointOffsets:
    """Estimated offsets of J joint values.

    Attributes:
        offsets_rad, sds_rad: Offsets (J,) and their standard deviations (J,).
        moves_px: Root mean square (J,) of how far each offset moves the outline, where no motion of
            the whole robot does the same: a turn about the axis of a round base moves next to nothing.
    """

    offsets_rad: Array
    sds_rad: Array
    moves_px: Array

    def __post_init__(self) -> None:
        for name in ("offsets_rad", "sds_rad", "moves_px"):
            freeze(self, name, getattr(self, name), (None,))


def joint_offsets(evidence: list[ViewEvidence]) -> JointOffsets:
    """Estimate joint offsets from at least one view.

    Joints and similarity are solved together, linearly about the drawn state, so that offsets of
    more than some ten degrees are only recognised as large.
    """
    offsets = _joint_step(evidence)[7:]
    covariance = _jackknife(evidence, _joint_step, 7 + len(offsets))
    weights = np.concatenate([view.border_weights for view in evidence])
    whole = np.concatenate([view.jacobian for view in evidence])
    own = np.concatenate([view.joint_jacobian for view in evidence])
    same = np.linalg.lstsq(np.sqrt(weights)[:, None] * whole, np.sqrt(weights)[:, None] * own, rcond=None)[0]
    left = own - whole @ same
    return JointOffsets(
        offsets_rad=offsets,
        sds_rad=np.sqrt(np.diag(covariance)[7:]),
        moves_px=np.abs(offsets) * np.sqrt(weights @ left**2 / weights.sum()),
    )


def _jackknife(
    evidence: list[ViewEvidence], solve: Callable[[list[ViewEvidence]], Array], size: int = 7
) -> Array:
    groups = min(GROUPS, len(evidence))
    if groups < 3:
        return np.diag(np.full(size, np.inf))
    member = np.arange(len(evidence)) * groups // len(evidence)
    left_out = np.stack(
        [
            solve([view for view, own in zip(evidence, member, strict=True) if own != group])
            for group in range(groups)
        ]
    )
    apart = left_out - left_out.mean(0)
    return (groups - 1) / groups * apart.T @ apart


def _similarity_step(evidence: list[ViewEvidence]) -> Array:
    """Step (7,) to the robust optimum of the edges, from the rendered pose."""
    J = np.concatenate([view.jacobian for view in evidence])
    shifts = np.concatenate([view.edge_px for view in evidence])
    weights = np.concatenate([view.edge_weights for view in evidence])
    plain = weights * (1 + shifts**2) ** 2
    step = np.zeros(7)
    for _ in range(10):
        fading = plain / (1 + (shifts - J @ step) ** 2) ** 2
        step = _solve(J, fading, shifts)
    return step


def _joint_step(evidence: list[ViewEvidence]) -> Array:
    """Step (7 + J,) of similarity and joints to the color borders."""
    J = np.concatenate([np.concatenate([view.jacobian, view.joint_jacobian], axis=1) for view in evidence])
    shifts = np.concatenate([view.border_px for view in evidence])
    weights = np.concatenate([view.border_weights for view in evidence])
    prior = np.zeros(J.shape[1])
    prior[7:] = 1 / JOINT_PRIOR_RAD**2
    return _solve(J, weights, shifts, prior)


def _solve(J: Array, weights: Array, shifts: Array, prior: Array | float = 0.0) -> Array:
    A = J.T @ (weights[:, None] * J)
    A += np.diag(np.full(len(A), 1e-9 * np.trace(A)) + prior)
    return np.asarray(np.linalg.solve(A, J.T @ (weights * shifts)), np.float64)
