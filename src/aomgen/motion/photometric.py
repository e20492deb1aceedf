"""Joint and joint values refined so that the moved part, drawn from its Gaussians, matches the video.

The hand's path gives a first answer and a prior. The video is compared inside the part's painted
surface only: its outline in the scan is no better than a label's edge, and the cavity behind it and
its own inside were never seen. An answer counts only if frames that were not fitted agree.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import Joint
from aomgen.core.values import Array, freeze
from aomgen.motion.inputs import MotionInput
from aomgen.motion.kinematic_prior import KinematicPrior
from aomgen.motion.part_renderer import PartRenderer, make_part_renderer
from aomgen.motion.photometric_residuals import Band, compare_frames
from aomgen.motion.photometric_solver import PhotometricProblem
from aomgen.robots.robot_masks import MasksAt

# Time from the motion after which, and before which, the part surely rests, [s].
_SETTLED_S: Final = 0.1
# Fewer frames that show the part tell nothing.
MIN_FRAMES: Final = 3
# Fewer frames at rest have no median to paint the part with.
_MIN_RESTING: Final = 2
# Evidence of the held-out frames has to improve by this many of its standard errors.
_ACCEPT_SD: Final = 2.0
# Share of the video's detail that the rendered part has to explain: with less, its light has changed more than its pose.
MIN_EXPLAINED: Final = 0.5
# Error of a calibrated camera's pose, which turns and moves the joint with it, each component, [rad].
_CAMERA_SD_RAD: Final = 0.001
# The same of its position, [m].
_CAMERA_SD_M: Final = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricParams:
    """How the video is compared.

    Attributes:
        knots: Frames that are fitted, spread evenly over the joint's values; as many are held out.
        max_pixels: Size of the crop around the part, [px^2].
        dilate_px: Margin around the robot, [px].
        bands: Image detail, coarse to fine.
        rounds: Gauss-Newton steps in each band.
    """

    knots: int = 10
    max_pixels: int = 30000
    dilate_px: int = 3
    bands: tuple[Band, ...] = (
        Band(blur_px=3.0, wide_px=6.0, margin_px=2),
        Band(blur_px=1.5, wide_px=5.0, margin_px=2),
        Band(blur_px=0.7, wide_px=4.0, margin_px=2),
    )
    rounds: int = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutEvidence:
    """How the frames that were not fitted judge.

    Attributes:
        cost_before, cost_after: Mean robust cost, 0..1.
        improvement_sd: Improvement over its standard error.
        explained: Median share of the video's detail that the refined answer explains, 1 at best.
    """

    cost_before: float
    cost_after: float
    improvement_sd: float
    explained: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricRefinement:
    """The answer after the video was asked.

    Attributes:
        joint: Refined, or the hand's if not accepted.
        thetas: Values at the video's frames (T,), [rad] or [m].
        theta_sd: Standard deviation (T,).
        covariance: Of tilt (2) [rad] and, if revolute, shift (2) [m] of the axis in the directions
            `tangent_basis(hand.joint.axis)`, the shift where the axis passes the held point.
        accepted: The video agrees better with the refined answer, on frames that were not fitted.
        evidence: Of the held-out frames; None where the video shows too little.
        reason: Why it was not accepted, or "".
    """

    joint: Joint
    thetas: Array
    theta_sd: Array
    covariance: Array
    accepted: bool
    evidence: HeldOutEvidence | None
    reason: str

    def __post_init__(self) -> None:
        freeze(self, "thetas", self.thetas, (None,))
        freeze(self, "theta_sd", self.theta_sd, (len(self.thetas),))
        freeze(self, "covariance", self.covariance, (None, None))

    @property
    def axis_sd_rad(self) -> float:
        """Root of the summed variances of the axis direction, [rad]."""
        return float(np.sqrt(np.trace(self.covariance[:2, :2])))

    @property
    def origin_sd_m(self) -> float:
        """Root of the summed variances of the axis line at the held point, [m]; 0 if prismatic."""
        return float(np.sqrt(np.trace(self.covariance[2:, 2:])))


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricFrames:
    """What the video shows of the part.

    Attributes:
        renderer: Around the part's way, and the part painted.
        fitted: Frames that answers are fitted to.
        held_out: Frames that judge them.
    """

    renderer: PartRenderer
    fitted: NDArray[np.intp]
    held_out: NDArray[np.intp]


def select_frames(
    demo: MotionInput, masks_at: MasksAt, hand: KinematicPrior, params: PhotometricParams | None = None
) -> PhotometricFrames | None:
    """Read the video; None where it shows too little of the part before or during the motion.

    Args:
        demo: Video, camera, and the scene as scanned.
        masks_at: Draws the robot.
        hand: Where and when the part goes, roughly.
        params: See there.
    """
    params = params or PhotometricParams()
    fitted, held_out, resting = choose_frames(hand, params.knots)
    if len(fitted) < MIN_FRAMES or len(resting) < _MIN_RESTING:
        return None
    moments = (resting, np.concatenate([fitted, held_out]), float(hand.thetas.max()))
    renderer = make_part_renderer(
        demo, masks_at, hand.joint, moments, max_pixels=params.max_pixels, dilate_px=params.dilate_px
    )
    return PhotometricFrames(renderer=renderer, fitted=fitted, held_out=held_out)


def refine(
    seen: PhotometricFrames | None, hand: KinematicPrior, params: PhotometricParams | None = None
) -> PhotometricRefinement:
    """Ask the video about joint and joint values.

    Args:
        seen: The video as read for this answer; where it is None the hand's answer stays.
        hand: First answer and prior.
        params: See there.

    Source: AOMGen, sec. 4.2, "Movable Part Motion Recovery"; the refinement is ours. Not checked: camera
    errors that leave the part at rest where it is.
    """
    params = params or PhotometricParams()
    if seen is None:
        return _kept(hand, "the film shows too few frames before or during the motion")
    problem = PhotometricProblem.of(seen.renderer, hand, seen.fitted)
    y, covariance = problem.solve(params.bands, params.rounds)
    return _judged(problem, y, covariance, seen.held_out, params)


def choose_frames(
    hand: KinematicPrior, knots: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Fitted, held-out and resting frames; the first two alternate and spread over the values.

    A quick motion has few frames; those of the part at its last place make up for them.
    """
    times = hand.times_s
    moving = np.flatnonzero((times >= hand.interval[0]) & (times <= hand.interval[1]))
    resting = np.flatnonzero(times < hand.interval[0] - _SETTLED_S)
    arrived = np.flatnonzero(times > hand.interval[1] + _SETTLED_S)
    if not hand.interval[1] > hand.interval[0]:
        return moving[:0], moving[:0], resting
    if len(moving):
        levels = np.linspace(0, 1, 2 * knots + 1)[1:] * float(hand.thetas[moving].max())
        rising = np.maximum.accumulate(hand.thetas[moving]) + 1e-9 * np.arange(len(moving))
        moving = moving[np.unique(np.interp(levels, rising, np.arange(len(moving))).round().astype(int))]
    missing = min(2 * knots - len(moving), len(arrived))
    after = arrived[np.linspace(0, len(arrived) - 1, missing).astype(int)] if missing > 0 else arrived[:0]
    chosen = np.concatenate([moving, after])
    return chosen[1::2], chosen[::2], resting


def _judged(
    problem: PhotometricProblem,
    y: Array,
    covariance: Array,
    frames: NDArray[np.intp],
    params: PhotometricParams,
) -> PhotometricRefinement:
    """The refined answer if held-out frames (N,) agree better with it."""
    hand, joint, thetas = problem.hand, problem.joint(y), np.maximum(problem.thetas(y), 0.0)
    seen = compare_frames(
        problem.renderer, frames, (hand.joint, hand.thetas), (joint, thetas), params.bands[-1]
    )
    if len(seen) < MIN_FRAMES:
        return _kept(hand, f"{len(seen)} held-out frames show the part's painted surface, need {MIN_FRAMES}")
    gains = np.array([item.cost_before - item.cost_after for item in seen])
    improvement = float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-9))
    explained = float(np.median([item.explained_after for item in seen]))
    evidence = HeldOutEvidence(
        cost_before=float(np.mean([item.cost_before for item in seen])),
        cost_after=float(np.mean([item.cost_after for item in seen])),
        improvement_sd=improvement,
        explained=explained,
    )
    if not explained >= MIN_EXPLAINED:
        reason = f"the painted part explains {explained:.2f} of the film's detail, need {MIN_EXPLAINED:.2f}"
        return replace(_kept(hand, reason), evidence=evidence)
    if not improvement >= _ACCEPT_SD:
        reason = f"held-out frames improve by {improvement:.1f} standard errors, need {_ACCEPT_SD:.1f}"
        return replace(_kept(hand, reason), evidence=evidence)
    count = problem.joint_count
    sds = np.repeat([_CAMERA_SD_RAD, _CAMERA_SD_M], 2)[:count]
    by_unknown = np.hstack([problem.lever, problem.spread])
    variance = np.einsum("ti,ij,tj->t", by_unknown, covariance, by_unknown)
    return PhotometricRefinement(
        joint=replace(joint, upper=float(thetas.max())),
        thetas=thetas,
        theta_sd=np.sqrt(np.maximum(variance, 0)),
        covariance=covariance[:count, :count] + np.diag(sds**2),
        accepted=True,
        evidence=evidence,
        reason="",
    )


def _kept(hand: KinematicPrior, reason: str) -> PhotometricRefinement:
    return PhotometricRefinement(
        joint=hand.joint,
        thetas=hand.thetas,
        theta_sd=hand.theta_sd,
        covariance=hand.covariance,
        accepted=False,
        evidence=None,
        reason=reason,
    )
