"""Refinement of joint and joint values so that the rendering of the moved part matches the video.

The gripper's path gives a first estimate and a prior, which Gauss-Newton on pixels refines. An estimate is
accepted only if held-out frames agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import Joint
from aomgen.core.robust import OUTLIER_SD, weigh
from aomgen.core.values import Array
from aomgen.motion.inputs import MotionInput
from aomgen.motion.kinematic_prior import KinematicPrior, shift_joint
from aomgen.motion.part_renderer import (
    Band,
    JointState,
    PartRenderer,
    find_interior,
    fit_gain,
    linearize_frame,
    make_part_renderer,
)
from aomgen.robots.silhouette import MasksAt

# Time before and after the motion beyond which the part certainly rests, [s].
SETTLED_S = 0.1
# Fewer frames that show the part give no evidence; fewer at rest have no median to texture it with.
_MIN_FRAMES, _MIN_RESTING = 3, 2
# Gauss-Newton steps in each band; the second one changes little.
_ROUNDS = 3
# Evidence of the held-out frames has to improve by this many of its standard errors.
_ACCEPT_SD = 2.0
# Share of the video's detail that the rendered part has to explain: with less, its light has
# changed more than its pose.
_MIN_EXPLAINED = 0.5
# Error of each component of a calibrated camera's pose, which moves the joint with it, [rad] and [m].
_CAMERA_SD = 0.001
# Deviations of the values are correlated over this share of the motion, except for this
# share of their variance.
_ALIKE_SHARE, _ROUGHNESS = 0.5, 0.05
# Smooth image displacements by the errors of shape and cameras, [px]; they persist, so that all
# frames have about two of them.
_DISTORTION_PX, _DISTORTIONS = 0.1, 2
# Image displacement by which derivatives are measured, [px].
_STEP_PX = 0.5
# A joint, and its values at the video's frames (T,).
JointMotion = tuple[Joint, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricParams:
    """Parameters of the comparison with the video.

    Attributes:
        knots: Number of frames that are fitted, spread evenly over the joint's values; as many are held out.
        max_pixels: Size of the crop around the part, [px^2].
        bands: Image detail, coarse to fine.
    """

    knots: int = 10
    max_pixels: int = 30000
    bands: tuple[Band, ...] = (
        Band(blur_px=3.0, wide_px=6.0),
        Band(blur_px=1.5, wide_px=5.0),
        Band(blur_px=0.7, wide_px=4.0),
    )


DEFAULTS = PhotometricParams()


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricFrames:
    """The video around the textured part: frames for fitting, frames for validation, and bands of detail."""

    renderer: PartRenderer
    fitted: NDArray[np.intp]
    held_out: NDArray[np.intp]
    bands: tuple[Band, ...]


def select_frames(
    demo: MotionInput, masks_at: MasksAt, prior: KinematicPrior, params: PhotometricParams = DEFAULTS
) -> PhotometricFrames | None:
    """Read the video around the expected motion; None where it shows too little before or during that."""
    fitted, held_out, resting = choose_frames(prior, params.knots)
    if len(fitted) < _MIN_FRAMES or len(resting) < _MIN_RESTING:
        return None
    moments = resting, np.concatenate([fitted, held_out]), float(prior.thetas.max())
    renderer = make_part_renderer(demo, masks_at, prior.joint, moments, params.max_pixels)
    return PhotometricFrames(renderer=renderer, fitted=fitted, held_out=held_out, bands=params.bands)


def choose_frames(
    prior: KinematicPrior, knots: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Choose fitted, held-out and resting frames; the first two alternate and spread over the values.

    A fast motion has few frames; those of the part in its last pose make up for them.
    """
    times, (begin, end) = prior.times_s, prior.interval
    moving = np.flatnonzero((times >= begin) & (times <= end))
    resting = np.flatnonzero(times < begin - SETTLED_S)
    arrived = np.flatnonzero(times > end + SETTLED_S)
    if not end > begin:
        return moving[:0], moving[:0], resting
    if len(moving):
        levels = np.linspace(0, 1, 2 * knots + 1)[1:] * float(prior.thetas[moving].max())
        rising = np.maximum.accumulate(prior.thetas[moving]) + 1e-9 * np.arange(len(moving))
        moving = moving[np.unique(np.interp(levels, rising, np.arange(len(moving))).round().astype(int))]
    missing = max(0, min(2 * knots - len(moving), len(arrived)))
    after = arrived[np.linspace(0, len(arrived) - 1, missing).astype(int)]
    chosen = np.concatenate([moving, after])
    return chosen[1::2], chosen[::2], resting


def refine(seen: PhotometricFrames | None, prior: KinematicPrior) -> KinematicPrior | None:
    """Refine joint and values on the video, from the prior; None where held-out frames do not confirm them.

    Source: AOMGen, sec. 4.2, "Movable Part Motion Recovery"; the refinement is ours. Not checked: camera
    errors that do not move the part at rest.
    """
    if seen is None:
        return None
    problem = _Problem.of(prior, seen.fitted)
    answer = problem.answer(*_solve(problem, seen.renderer, seen.bands))
    motions = (prior.joint, prior.thetas), (answer.joint, answer.thetas)
    gains, explained, _ = compare_frames(seen, motions)
    if not _explains(explained[:, 1]):
        return None
    error = gains.std(ddof=1) / np.sqrt(len(gains))
    return answer if float(gains.mean() / max(error, 1e-9)) >= _ACCEPT_SD else None


def compute_type_margin(seen: PhotometricFrames | None, candidates: tuple[JointMotion, JointMotion]) -> float:
    """Compute twice the log evidence of the video for the first estimate over the second; 0 if inconclusive.

    Frames to which no estimate was fitted are compared in squares of the part's textured surface.

    Args:
        seen: The video as read for the first estimate's type.
        candidates: The first and the second estimate, each refined on the video.

    Not checked: that the residuals of different frames are independent of each other.
    """
    if seen is None:
        return 0.0
    gains, explained, squares = compare_frames(seen, (candidates[1], candidates[0]))
    # Each square counts once.
    margin = OUTLIER_SD**2 * float(squares @ gains)
    return margin if _explains(explained[:, int(margin > 0)]) else 0.0


def compute_motion_margin(seen: PhotometricFrames | None, answer: JointMotion) -> float:
    """Compute twice the log evidence of the video for an estimate over a part at rest; 0 if no frame can be compared.

    The margin also counts where neither explains most of the detail: the arm's shadow on a resting part
    lowers the share that rest explains, and such a part must be detected.

    Args:
        seen: The video as read for the estimate's type.
        answer: Estimated joint and joint values.

    Not checked: that the residuals of different frames are independent of each other.
    """
    if seen is None:
        return 0.0
    joint, thetas = answer
    gains, _, squares = compare_frames(seen, ((joint, np.zeros_like(thetas)), answer))
    return OUTLIER_SD**2 * float(squares @ gains)


def compare_frames(
    seen: PhotometricFrames, candidates: tuple[JointMotion, JointMotion]
) -> tuple[Array, Array, Array]:
    """Compare two estimates at the F held-out frames that show enough of the part, over the pixels that both show.

    Returns:
        Mean robust cost of the first estimate less that of the second (F,), -1..1; share of the video's detail
        that each estimate explains (F, 2), 1 at best; number of independent squares that were compared (F,).
    """
    gains, explained, squares = [], [], []
    band = seen.bands[-1]
    for frame in seen.held_out:
        picture, hidden = seen.renderer.at(frame)
        views = [seen.renderer.draw(joint, float(thetas[frame])) for joint, thetas in candidates]
        mask = find_interior(views[0], hidden) & find_interior(views[1], hidden)
        if mask.sum() < band.shading_px:
            continue
        lights = [fit_gain(picture, view, mask, band) for view in views]
        sd = min(light.sd for light in lights)
        squared = np.stack([light.residuals for light in lights]) ** 2
        weights = weigh(np.sqrt(squared), sd)
        detail = np.stack([light.detail for light in lights]) ** 2
        costs = np.mean(squared / (squared + (OUTLIER_SD * sd) ** 2), axis=1)
        gains.append(costs[0] - costs[1])
        explained.append(1 - (weights * squared).sum(1) / np.maximum((weights * detail).sum(1), 1e-12))
        squares.append(mask.sum() / band.shading_px)
    explained = np.reshape(explained, (len(squares), 2))
    return np.array(gains), explained, np.array(squares)


def _explains(shares: Array) -> bool:
    """Check whether enough frames were compared, and an estimate explains most of the detail: shares (F,)."""
    return len(shares) >= _MIN_FRAMES and float(np.median(shares)) >= _MIN_EXPLAINED


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """Unknowns y (n + K,): n parameters of `shift_joint`, and deviations of the values at K frames.

    Attributes:
        prior: First estimate, y = 0.
        frames: (K,) of the video.
        lever: Change of the values with the unknowns (T, n + K).
        precision: Precision of the prior (n + K, n + K).
    """

    prior: KinematicPrior
    frames: NDArray[np.intp]
    lever: Array
    precision: Array

    @staticmethod
    def of(prior: KinematicPrior, frames: NDArray[np.intp]) -> "_Problem":
        """Model the values' deviations as a smooth process while the part moves, and constant afterwards."""
        begin, end = prior.interval
        moments = np.clip(prior.times_s, begin, end)
        apart = (moments[:, None] - moments[frames]) / (_ALIKE_SHARE * (end - begin))
        alike = np.exp(-0.5 * apart**2)
        own = np.linalg.inv(alike[frames] + _ROUGHNESS * np.eye(len(frames)))
        moves = ((prior.thetas > 0) | (prior.times_s >= begin))[:, None]
        spread = prior.theta_sd[:, None] * (alike @ own)
        count = len(prior.covariance)
        precision = np.zeros((count + len(frames),) * 2)
        precision[:count, :count] = np.linalg.inv(prior.covariance)
        precision[count:, count:] = own
        return _Problem(
            prior=prior,
            frames=frames,
            lever=moves * np.hstack([prior.value_lever(), spread]),
            precision=precision,
        )

    def place(self, z: Array) -> JointState:
        """Return the joint state for the joint's parameters and a value (n + 1,)."""
        return shift_joint(self.prior.joint, self.prior.pivot, z[:-1]), float(z[-1])

    def thetas(self, y: Array) -> Array:
        """Compute values (T,)."""
        return self.prior.thetas + self.lever @ y

    def answer(self, y: Array, covariance: Array) -> KinematicPrior:
        """Convert unknowns and their covariance (n + K, n + K) to an estimate, with errors of the camera."""
        count = len(self.prior.covariance)
        thetas = np.maximum(self.thetas(y), 0.0)
        variance = np.einsum("ti,ij,tj->t", self.lever, covariance, self.lever)
        joint = shift_joint(self.prior.joint, self.prior.pivot, y[:count])
        return replace(
            self.prior,
            joint=replace(joint, upper=float(thetas.max())),
            thetas=thetas,
            theta_sd=np.sqrt(np.maximum(variance, 0)),
            covariance=covariance[:count, :count] + _CAMERA_SD**2 * np.eye(count),
        )


def _solve(problem: _Problem, renderer: PartRenderer, bands: Sequence[Band]) -> tuple[Array, Array]:
    """Solve for the unknowns (n + K,) and their covariance by Gauss-Newton."""
    count = len(problem.prior.covariance)
    steps = _choose_steps(renderer, problem.prior.joint)
    shift_sd_px = _DISTORTION_PX * float(np.sqrt(len(problem.frames) / _DISTORTIONS))
    y, total = np.zeros(len(problem.precision)), problem.precision
    for band in [band for band in bands for _ in range(_ROUNDS)]:
        total, gradient = problem.precision, -problem.precision @ y
        thetas = problem.thetas(y)
        for frame in problem.frames:
            z = np.append(y[:count], thetas[frame])
            places = [problem.place(z + step) for step in np.vstack([0 * steps, np.diag(steps)])]
            seen = linearize_frame(renderer, int(frame), places, steps, band, shift_sd_px)
            if seen is not None:
                residuals, derivatives, weights = seen
                J = derivatives @ np.vstack([np.eye(count, len(y)), problem.lever[frame]])
                total = total + J.T * weights @ J
                gradient = gradient + J.T @ (weights * residuals)
        y = y + np.linalg.solve(total, gradient)
    return y, np.asarray(np.linalg.inv(total), np.float64)


def _choose_steps(renderer: PartRenderer, joint: Joint) -> Array:
    """Choose steps of tilt (2), shift (2, revolute only) and value that move the image by `_STEP_PX`."""
    camera = renderer.camera
    meters = _STEP_PX * float(np.linalg.norm(renderer.focus - camera.center)) / camera.fx
    turn = meters / renderer.reach_m
    return np.array([turn, turn, meters] if joint.type == "prismatic" else [turn, turn, meters, meters, turn])
