"""AOMotion: interval, contact, joint and joint values of the part from one demonstration."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import root_scalar

from aomgen.core.joint import JointType
from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.errors import DemonstrationTooShortError, InputError
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointCandidates, JointParams, choose_type
from aomgen.motion.joint_trajectory import TouchRecovery
from aomgen.motion.kinematic_prior import KinematicPrior
from aomgen.motion.observations import VideoObservations
from aomgen.motion.photometric import (
    PhotometricFrames,
    PhotometricParams,
    compute_motion_margin,
    compute_type_margin,
    refine,
    select_frames,
)
from aomgen.robots.silhouette import robot_masks


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionParams:
    """Parameters of AOMotion.

    Attributes:
        joint: Parameters of the joint estimate.
        photometric: Parameters of its refinement on the video.
        contact_steps: Number of moments at the start of the motion at which contact patches are searched.
        width: Image width for keyframes, [px].
    """

    joint: JointParams = field(default_factory=JointParams)
    photometric: PhotometricParams = field(default_factory=PhotometricParams)
    contact_steps: int = 7
    width: int = 320


# Directions over which the 95 % radius is integrated: exact to 0.1 % even where one variance is zero.
_RADIUS_NODES = 512


# Callback that receives the motion score before any refusal that depends on it.
OnCurve = Callable[[MotionCurve], None]


def ignore_curve(curve: MotionCurve) -> None:
    """Ignore the motion curve; default of the callback."""


def estimate_motion(
    demo: MotionInput,
    params: MotionParams | None = None,
    progress: Progress = silent,
    on_curve: OnCurve = ignore_curve,
) -> MotionEstimate:
    """Recover the part's motion.

    Args:
        demo: Video, log and scan.
        params: Parameters of the submodules.
        progress: Receives the progress.
        on_curve: Receives the motion score as soon as it is known, before any refusal that depends on it.

    Raises:
        WrongPromptError: The gripper moved something else than the prompted part.
        NoMotionError: The part does not move in the video.
        DemonstrationTooShortError, AmbiguousJointError: The motion does not determine the joint.
        InputError: A part has hardly any points.

    Source: AOMGen, sec. 4.2, AOMotion.
    """
    params = params or MotionParams()
    for name, points in (("moving", demo.points_moving), ("static", demo.points_static)):
        if not len(points) >= 20:
            raise InputError(f"'{name}' part", f"has {len(points)} points, need 20", "correct its prompts")
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        progress(0.0, "keyframes")
        view = VideoObservations.of(demo, masks_at, params.width)
        on_curve(view.curve)
        evidence = view.weigh_motion(demo)
        moved = view.identify_part(demo)
        if moved.gripped or evidence.log_likelihood_ratio > 0:
            moved.check()
        evidence.check()
        progress(0.4, "joint")
        recovery = TouchRecovery.of(demo, view, params.joint, params.contact_steps)
        first = recovery.first_candidates()

        def estimate_type(
            joint_type: JointType,
        ) -> tuple[JointCandidates, PhotometricFrames | None, MotionEstimate]:
            """Return the candidates, the compared frames, and the estimate, refined where these confirm it."""
            found, estimate = recovery.recover(first, joint_type, moved.odds)
            lines = (found.of(joint_type).axes, found.of(joint_type).origins)
            prior = KinematicPrior.of(demo, estimate, lines)
            seen = select_frames(demo, masks_at, prior, params.photometric)
            answer = refine(seen, prior)
            return found, seen, estimate if answer is None else _take_over(estimate, answer)

        likely: JointType = "revolute" if first.margin > 0 else "prismatic"
        found, seen, answer = recovered = estimate_type(likely)
        try:
            rival = estimate_type("prismatic" if likely == "revolute" else "revolute")
        except DemonstrationTooShortError:
            # Under the wrong type, the gripper may seem to leave the part at once, so that no motion is left to explain.
            # The path alone must then decide for the other type.
            if choose_type(found) != likely:
                raise
            rival = None
    progress(0.9, "type of the joint")
    margin = found.margin
    if rival is not None:
        (found_door, seen, opened), (found_drawer, seen_drawer, drawn) = (
            (recovered, rival) if likely == "revolute" else (rival, recovered)
        )
        video_margin = compute_type_margin(seen, ((opened.joint, opened.thetas), (drawn.joint, drawn.thetas)))
        found = min((found_door, found_drawer), key=lambda item: abs(item.margin))
        answer = opened
        if choose_type(found, video_margin) == "prismatic":
            seen, answer = seen_drawer, drawn
        margin = found.margin + video_margin
    # Shadows of the arm may look like a motion of the part, until a motion is compared with the video.
    replace(evidence, video_margin=compute_motion_margin(seen, (answer.joint, answer.thetas))).check()
    return replace(answer, type_margin=abs(margin))


def first_motion(demo: MotionInput) -> MotionEstimate:
    """Estimate the motion from the gripper's path alone, without refinement on the video or quality checks.

    It determines which Gaussians move, also where labels are too poor for `estimate_motion`.

    Raises: as `estimate_motion`.
    """
    params = MotionParams()
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        view = VideoObservations.of(demo, masks_at, params.width)
    recovery = TouchRecovery.of(demo, view, params.joint, params.contact_steps)
    first = recovery.first_candidates()
    joint_type = "revolute" if first.margin > 0 else "prismatic"
    return recovery.recover(first, joint_type)[1]


def _take_over(estimate: MotionEstimate, answer: KinematicPrior) -> MotionEstimate:
    """Replace joint, values and their errors in an estimate by those of a refined one."""
    tilt, shift = answer.covariance[:2, :2], answer.covariance[2:, 2:]
    return replace(
        estimate,
        joint=answer.joint,
        thetas=answer.thetas,
        theta_sd=answer.theta_sd,
        axis_sd_rad=float(np.sqrt(np.trace(tilt))),
        origin_sd_m=float(np.sqrt(np.trace(shift))),
        axis_ci95_rad=find_radius_95(tilt),
        origin_ci95_m=find_radius_95(shift) if len(shift) else 0.0,
    )


def find_radius_95(covariance: Array) -> float:
    """Find the radius that holds 95 % of a centered normal distribution in the plane, covariance (2, 2).

    In a direction of variance v, the squared radius is v times a chi-square variable of two degrees of freedom, so the
    probability of a radius r is the mean of `1 - exp(-r^2 / 2 v)` over all directions of the standard normal.
    """
    low, high = np.linalg.eigvalsh(covariance)
    # The integrand has period pi; equally spaced nodes at half steps converge geometrically and avoid v = 0.
    angles = (np.arange(_RADIUS_NODES) + 0.5) * (np.pi / _RADIUS_NODES)
    variances = np.maximum(low, 0.0) * np.sin(angles) ** 2 + high * np.cos(angles) ** 2

    def excess(radius: float) -> float:
        return float(np.mean(1 - np.exp(-(radius**2) / (2 * variances)))) - 0.95

    sd = float(np.sqrt(high))
    return float(root_scalar(excess, bracket=(0.0, 3 * sd), xtol=1e-6 * sd).root)
