"""Estimate of the motion from the gripper's path, as a prior for the video."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from aomgen.core.joint import Joint
from aomgen.core.motion import MotionEstimate
from aomgen.core.transforms import apply, make_tangent_basis
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.motion.inputs import MotionInput

# Regularization far below any error of a joint, so that a covariance can be inverted, [rad^2], [m^2].
_LEAST_VARIANCE = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicPrior:
    """Joint and joint values with independent errors.

    Attributes:
        joint: World frame; value 0 is the scanned state.
        held_world: Held point when the motion begins, [m].
        covariance: Covariance of the parameters of `shift_joint`: tilt [rad] and, if revolute, shift [m].
        interval: First and last moment of the motion, [s].
        times_s: Times of the video's frames.
        thetas: Values, [rad] or [m].
        theta_sd: Standard deviation of the values if the joint is exact.
    """

    joint: Joint
    held_world: Vector3
    covariance: Annotated[Array, "n n"]
    interval: tuple[float, float]
    times_s: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    theta_sd: Annotated[Array, "T"]

    __post_init__ = freeze_arrays

    @staticmethod
    def of(demo: MotionInput, estimate: MotionEstimate, lines: tuple[Array, Array]) -> "KinematicPrior":
        """Build the prior from an estimate and likely `lines`: axes (S, 3) and points on them (S, 3) [m]."""
        joint, held = estimate.joint, apply(demo.ee_poses_at([estimate.start_s]), estimate.grasp_ee)[0]
        prior = KinematicPrior(
            joint=joint,
            held_world=held,
            covariance=compute_line_covariance(joint, _find_pivot(joint, held), lines),
            interval=(estimate.start_s, estimate.end_s),
            times_s=estimate.times_s,
            thetas=estimate.thetas,
            theta_sd=estimate.theta_sd,
        )
        lever = prior.value_lever()
        by_joint = np.einsum("ti,ij,tj->t", lever, prior.covariance, lever)
        # The variance without the joint's error, which must stay positive.
        own = np.maximum(estimate.theta_sd**2 - by_joint, estimate.theta_sd**2 / 9)
        return replace(prior, theta_sd=np.sqrt(own))

    @property
    def pivot(self) -> Array:
        """Point of the axis nearest the held point (3,), world frame, [m]."""
        return _find_pivot(self.joint, self.held_world)

    def value_lever(self) -> Array:
        """Compute derivatives (T, n) of the values by `shift_joint`'s parameters, for a fixed held path.

        The held point moves around the pivot in the plane across the axis, so that a tilt changes nothing.
        """
        lever = np.zeros((len(self.thetas), len(self.covariance)))
        if self.joint.type == "revolute":
            points = np.asarray(apply(self.joint.motion(self.thetas), self.held_world))
            first = self.held_world - self.pivot
            change = np.cross(self.joint.axis, first - (points - self.pivot)) / (first @ first)
            lever[:, 2:] = change @ make_tangent_basis(self.joint.axis).T
        return lever


def _find_pivot(joint: Joint, held_world: Array) -> Array:
    return joint.origin + joint.axis * ((held_world - joint.origin) @ joint.axis)


def shift_joint(joint: Joint, pivot: Array, x: Array) -> Joint:
    """Tilt a joint by x[:2] [rad] and, if revolute, move it by x[2:4] [m] across its axis at `pivot` (3,)."""
    tangents = make_tangent_basis(joint.axis)
    axis = joint.axis + x[:2] @ tangents
    offset = x[2:4] @ tangents if joint.type == "revolute" else np.zeros(3)
    return replace(joint, axis=axis / np.linalg.norm(axis), origin=pivot + offset)


def compute_line_covariance(joint: Joint, pivot: Array, lines: tuple[Array, Array]) -> Array:
    """Compute the covariance (n, n) of `shift_joint`'s parameters from axes (S, 3) at points (S, 3)."""
    axes, points = lines
    tangents = make_tangent_basis(joint.axis)
    along = (axes @ joint.axis)[:, None]
    crossings = points + axes * ((pivot - points) @ joint.axis)[:, None] / along
    numbers = np.hstack([axes @ tangents.T / along, (crossings - pivot) @ tangents.T])
    numbers = numbers if joint.type == "revolute" else numbers[:, :2]
    # The covariance is about the estimate itself, which may differ from the mean of the samples.
    return numbers.T @ numbers / len(numbers) + _LEAST_VARIANCE * np.eye(numbers.shape[1])
