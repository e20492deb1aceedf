"""Estimate of the joint behind a demonstration: type, axis, origin and their uncertainty.

The part moves on a one-parameter path and the gripper moves with it. A handle may rotate in the fingers and
slip through them, so the gripper's pose is a measurement with noise (`joint_posterior`), and the parts' shape
is a weak prior (`part_shape`). Revolute and prismatic explanations compete by their evidence.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.errors import AmbiguousJointError, DemonstrationTooShortError
from aomgen.motion.ee_path import EePath, GraspGuess, thin_path
from aomgen.motion.joint_models import JointModel, Prismatic, Revolute, make_models
from aomgen.motion.joint_posterior import (
    BEND_SHARE,
    SCALES,
    NoisePrior,
    PathNoise,
    Posterior,
    compute_give_rate,
    compute_held_rate,
    compute_posterior,
    fit_path,
)
from aomgen.motion.part_shape import PartShape

_REMEDY = "record a longer demonstration"
# Shortest motion that determines a joint: an arc of fewer degrees hardly bends, [rad]; less travel may be
# slip of the gripper, [m].
_MIN_TURN_RAD, _MIN_TRAVEL_M = float(np.radians(15.0)), 0.03
# Smallest difference of the types' evidence, twice the logarithm as in BIC: "positive" evidence begins at 2.
_MIN_MARGIN = 3.0
# A path counts as straight only if an arc with the radius of a wide door, [m], differs by this many sigmas.
_DOOR_RADIUS_M, _STRAIGHT_SD = 0.6, 3.0
# Noise scales this many standard deviations above their medians are examined.
_UNUSUAL = 2.0
_TURNS = [SCALES.index(name) for name in ("turn", "tilt", "pivot")]


@dataclass(frozen=True, slots=True, kw_only=True)
class JointParams:
    """Parameters of the joint estimate from a path.

    Attributes:
        noise: Prior of the noise of a path.
        nodes: Number of segments that the path is reduced to.
    """

    noise: NoisePrior = field(default_factory=NoisePrior)
    nodes: int = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class JointEstimate:
    """A joint and its quality.

    Attributes:
        joint: Value 0 at the beginning of the path; `upper` is the observed travel.
        grasp_ee: The held point, end-effector frame, refined, [m].
        axis_sd_rad: Standard deviation of the direction of the axis, the root of the sum of the variances across it, [rad].
        origin_sd_m: Standard deviation of the position of the axis near the contact, likewise, [m]; 0 for a prismatic joint.
        axis_ci95_rad, origin_ci95_m: Half widths of the 95 % credible intervals of the direction and of the position.
        residual_m: Standard deviation of the gripper about the path of the part, [m].
        give_rate: Standard deviation of the slip of the gripper along the path per travel of the part, [m/m].
        turn_ratio: Rotation of the gripper divided by that of the part; 0 for a prismatic joint.
        margin: Twice the logarithm of the evidence for this type divided by that for the other one.
        axes, origins, grasps: S samples of the posterior distribution: axes, points on them [m], and held points [m].
    """

    joint: Joint
    grasp_ee: Vector3
    axis_sd_rad: float
    origin_sd_m: float
    axis_ci95_rad: float
    origin_ci95_m: float
    residual_m: float
    give_rate: float
    turn_ratio: float
    margin: float
    axes: Annotated[Array, "S 3"]
    origins: Annotated[Array, "S 3"]
    grasps: Annotated[Array, "S 3"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class JointCandidates:
    """The joint estimate of either type for a path.

    Attributes:
        margin: Twice the log evidence of revolute over prismatic.
        extent_m: Largest distance of the held point from its first position, [m].
        unseen_bulge_m: Arcs that bulge less than this from their chord look straight in this path, [m].
    """

    revolute: JointEstimate
    prismatic: JointEstimate
    margin: float
    extent_m: float
    unseen_bulge_m: float

    def of(self, joint_type: JointType) -> JointEstimate:
        """Return the best estimate of a type."""
        return self.revolute if joint_type == "revolute" else self.prismatic


def fit_candidates(
    Ts_world_ee: Array, hold: GraspGuess, shape: PartShape | None = None, params: JointParams | None = None
) -> JointCandidates:
    """Explain the gripper's poses while it holds the part by either type of joint.

    Args:
        Ts_world_ee, hold: End-effector poses (T, 4, 4) from the start to the end of the motion,
            in order, and the grasp.
        shape: The parts' shape, or None to use the path alone.
        params: Parameters of the estimate.

    Raises:
        DemonstrationTooShortError: The gripper moved the part less than 3 cm.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling"; the path fit replaces its edge decision,
    the edges remain as a prior. Not checked: that the gripper holds the same part all the time.
    """
    params = params or JointParams()
    path = thin_path(Ts_world_ee, hold, nodes=params.nodes)
    points = path.points_world
    extent = float(np.linalg.norm(points - points[0], axis=1).max())
    if not extent >= _MIN_TRAVEL_M:
        raise DemonstrationTooShortError(
            "joint",
            f"the gripper moved the part {extent * 1e3:.1f} mm, need {_MIN_TRAVEL_M * 1e3:.0f} mm",
            _REMEDY,
        )
    doors, drawer = make_models(path, np.inf if shape is None else shape.reach_m(points.mean(0)))
    noise = _loosen_ends(PathNoise.of(points, params.noise), (doors, [drawer]))
    hinges, rails = ([], []) if shape is None else (shape.revolute_priors(), shape.prismatic_priors())
    revolute, prismatic = compute_posterior(doors, noise, hinges), compute_posterior([drawer], noise, rails)
    margin = 2 * (revolute.log_evidence - prismatic.log_evidence)
    # The bulge is the middle half of the nodes against the outer half. Bars are parallel to hinges, so that
    # arcs bend in the direction in which the fingers hold best.
    unsteady = prismatic.scales[0] * np.sqrt(4 / len(points))
    slip = compute_held_rate(prismatic.scales, prismatic.model.closing_alignment) * extent
    return JointCandidates(
        revolute=_estimate(path, revolute, "revolute", margin),
        prismatic=_estimate(path, prismatic, "prismatic", -margin),
        margin=margin,
        extent_m=extent,
        unseen_bulge_m=_STRAIGHT_SD * float(np.hypot(unsteady, BEND_SHARE * slip)),
    )


def choose_type(found: JointCandidates, video_margin: float = 0.0) -> JointType:
    """Choose the joint type by the path and the video, given as twice its log evidence for revolute.

    Raises:
        DemonstrationTooShortError: Less than 15 degrees were shown.
        AmbiguousJointError: Both joint types explain path and video equally well.
    """
    margin = found.margin + video_margin
    turn = found.revolute.joint.upper
    # A motion is too short if a door would have rotated too little, unless the evidence favors a drawer.
    if margin > -_MIN_MARGIN and not turn >= _MIN_TURN_RAD:
        limit = np.degrees(_MIN_TURN_RAD)
        raise DemonstrationTooShortError(
            "joint", f"the part turned {np.degrees(turn):.2f} degrees, need {limit:.0f}", _REMEDY
        )
    if not abs(margin) >= _MIN_MARGIN:
        raise AmbiguousJointError(
            "joint",
            f"a revolute and a prismatic joint fit equally well (evidence differs by {abs(margin):.2f}, need "
            f"{_MIN_MARGIN:.1f})",
            _REMEDY,
        )
    if margin > 0:
        return "revolute"
    if not video_margin <= -_MIN_MARGIN:
        _refuse_hidden_arc(found)
    return "prismatic"


def estimate_joint(Ts_world_ee: Array, hold: GraspGuess, shape: PartShape | None = None) -> JointEstimate:
    """Estimate the joint from the path alone; arguments as in `fit_candidates`, errors as `choose_type`."""
    found = fit_candidates(Ts_world_ee, hold, shape)
    return found.of(choose_type(found))


def _loosen_ends(noise: PathNoise, types: tuple[list[Revolute], list[Prismatic]]) -> PathNoise:
    """Loosen end nodes at which the gripper did not hold the part, if the path is very unsteady."""

    def fit(noise: PathNoise) -> tuple[float, float]:
        fits = [fit_path(models, noise) for models in types]
        path, steps = max(fits, key=lambda item: item[0].log_posterior(item[1]))
        return path.log_posterior(steps), float(np.max(np.delete(steps, _TURNS)))

    best, unsteady = fit(noise)
    if unsteady < _UNUSUAL:
        return noise
    count = len(noise.travel_m)
    for ends in ([slice(count - k, count) for k in (1, 2, 4, 6)], [slice(0, k) for k in (1, 2, 4, 6)]):
        tried = [noise.loosen(nodes) for nodes in ends]
        evidences = [fit(item)[0] for item in tried]
        if max(evidences) > best:
            best, noise = max(evidences), tried[int(np.argmax(evidences))]
    return noise


def _refuse_hidden_arc(found: JointCandidates) -> None:
    """Refuse a straight path as evidence for a prismatic joint where a door's arc would not be visible."""
    bulge = found.extent_m**2 / (8 * _DOOR_RADIUS_M)
    if bulge >= found.unseen_bulge_m:
        return
    problem = (
        f"the path of {found.extent_m * 1e3:.0f} mm is straight, but a door of {_DOOR_RADIUS_M:.1f} m radius "
        f"would bend it by {bulge * 1e3:.2f} mm only, need {found.unseen_bulge_m * 1e3:.2f} mm"
    )
    if found.extent_m < _MIN_TURN_RAD * _DOOR_RADIUS_M:
        raise DemonstrationTooShortError("joint", problem, _REMEDY)
    raise AmbiguousJointError("joint", problem, "hold the handle firmly or record a longer motion")


def _estimate(path: EePath, found: Posterior, joint_type: JointType, margin: float) -> JointEstimate:
    model, x = found.model, found.mean
    values = model.values(x)
    travel = float(values[-1] - values[0])
    sign = 1.0 if travel >= 0 else -1.0
    held = path.points_world[0]
    revolute = joint_type == "revolute"
    axis, origin = (row[0] for row in _near(model, x[None], held))
    way = np.cross(axis, held - origin) if revolute else axis
    way = way / max(float(np.linalg.norm(way)), 1e-9)
    axes, origins = _near(model, found.draws, held)
    angles = np.arccos(np.clip(axes @ axis, -1.0, 1.0))
    across = (origins - origin) * revolute
    gaps = np.linalg.norm(across - np.outer(across @ axis, axis), axis=1)
    return JointEstimate(
        joint=Joint(
            type=joint_type,
            axis=sign * axis,
            origin=origin if revolute else held,
            lower=0.0,
            upper=abs(travel),
        ),
        grasp_ee=model.grasp(x),
        axis_sd_rad=float(np.sqrt(np.mean(angles**2))),
        origin_sd_m=float(np.sqrt(np.mean(gaps**2))),
        axis_ci95_rad=float(np.percentile(angles, 95)),
        origin_ci95_m=float(np.percentile(gaps, 95)),
        residual_m=float(found.scales[0]),
        give_rate=compute_give_rate(joint_type, found.scales, float(way @ path.closing_world)),
        turn_ratio=float(x[9]) if revolute else 0.0,
        margin=margin,
        axes=sign * axes,
        origins=origins,
        grasps=np.broadcast_to(model.grasp(found.draws), axes.shape),
    )


def _near(model: JointModel, x: Array, point: Array) -> tuple[Array, Array]:
    """Compute axis directions (S, 3) of unknowns (S, P) and points on them (S, 3) nearest to a point."""
    axes, points = model.lines(x)
    return axes, points + axes * ((point - points) * axes).sum(1, keepdims=True)
