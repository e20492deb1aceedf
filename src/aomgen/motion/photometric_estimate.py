"""The hand's answer, put right by the video where the video says more."""

from dataclasses import replace

import numpy as np

from aomgen.core.joint import Joint
from aomgen.core.motion import MotionEstimate
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_models import make_tangent_basis
from aomgen.motion.kinematic_prior import KinematicPrior
from aomgen.motion.photometric import PhotometricFrames, PhotometricParams, refine
from aomgen.motion.photometric_solver import compute_value_lever

# Samples from which a 95 % radius is read: good to about a percent.
_DRAWS = 4000
# Far below any error of a joint, so that a covariance can be inverted, [rad^2], [m^2].
_LEAST_VARIANCE = 1e-10


def refine_estimate(
    seen: PhotometricFrames | None,
    estimate: MotionEstimate,
    hand: KinematicPrior,
    params: PhotometricParams | None = None,
) -> MotionEstimate:
    """The estimate with joint, values and their errors refined on the video, or as it was.

    Args:
        seen: The video as read for the hand's answer.
        estimate: The hand's answer.
        hand: The same as a prior.
        params: Of the refinement.
    """
    refined = refine(seen, hand, params)
    if not refined.accepted:
        return estimate
    revolute = refined.joint.type == "revolute"
    return replace(
        estimate,
        joint=refined.joint,
        thetas=refined.thetas,
        theta_sd=refined.theta_sd,
        axis_sd_rad=refined.axis_sd_rad,
        origin_sd_m=refined.origin_sd_m,
        axis_ci95_rad=find_radius_95(refined.covariance[:2, :2]),
        origin_ci95_m=find_radius_95(refined.covariance[2:, 2:]) if revolute else 0.0,
    )


def make_kinematic_prior(
    demo: MotionInput, estimate: MotionEstimate, lines: tuple[Array, Array]
) -> KinematicPrior:
    """What an estimate says about the joint, as a prior.

    Args:
        demo: What the estimate was made from.
        estimate: The hand's answer.
        lines: Axes (S, 3) and points on them (S, 3) [m] that the hand finds equally likely, world frame.
    """
    held = apply(demo.robot.ee_poses(demo.log.at([estimate.start_s])[0]), estimate.grasp_ee)[0]
    joint = estimate.joint
    pivot = joint.origin + joint.axis * ((held - joint.origin) @ joint.axis)
    answer = KinematicPrior(
        joint=estimate.joint,
        held_world=held,
        covariance=compute_line_covariance(joint, pivot, lines),
        interval=(estimate.start_s, estimate.end_s),
        times_s=estimate.times_s,
        thetas=estimate.thetas,
        theta_sd=estimate.theta_sd,
    )
    lever = compute_value_lever(answer, pivot)
    by_joint = np.einsum("ti,ij,tj->t", lever, answer.covariance, lever)
    # The joint's own error is known to be at most what is left when it is taken out, and never all.
    own = np.maximum(estimate.theta_sd**2 - by_joint, estimate.theta_sd**2 / 9)
    return replace(answer, theta_sd=np.sqrt(own))


def compute_line_covariance(joint: Joint, pivot: Array, lines: tuple[Array, Array]) -> Array:
    """Covariance of tilt (2) and, if revolute, shift at `pivot` (2) of equally likely axes; see `KinematicPrior`."""
    axes, points = lines
    tangents = make_tangent_basis(joint.axis)
    along = axes @ joint.axis
    crossings = points + axes * (((pivot - points) @ joint.axis) / along)[:, None]
    numbers = np.hstack([axes @ tangents.T / along[:, None], (crossings - pivot) @ tangents.T])
    if joint.type == "prismatic":
        numbers = numbers[:, :2]
    # About the answer itself, which need not be the samples' middle.
    return np.asarray(
        numbers.T @ numbers / len(numbers) + _LEAST_VARIANCE * np.eye(numbers.shape[1]), np.float64
    )


def find_radius_95(covariance: Array) -> float:
    """Radius around the mean that holds 95 % of a normal distribution in the plane, covariance (2, 2)."""
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance, _DRAWS)
    return float(np.percentile(np.linalg.norm(draws, axis=1), 95))
