"""The joint behind a demonstration: type, axis, origin and how well they are known.

The part moves on a one-parameter path and the hand moves with it. A handle may turn in the fingers,
so the hand's turn is not the part's turn: the axis direction comes from the path's plane and the
hand's rotation axis together, the centre from the path, and the object's edges help where the path
is short. Revolute and prismatic explanations compete by BIC.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.values import Array, freeze
from aomgen.errors import AmbiguousJointError, DemonstrationTooShortError
from aomgen.motion.edges import EdgePrior
from aomgen.motion.joint_models import JointNoise, Solution, solve_prismatic, solve_revolute
from aomgen.motion.path import HandPath, thin


@dataclass(frozen=True, slots=True, kw_only=True)
class JointParams:
    """Limits of what is accepted as an answer.

    Attributes:
        noise: Assumed errors of the evidence.
        nodes: Stretches the path is thinned to.
        smooth: Samples averaged when measuring travel.
        min_turn_rad, min_travel_m: Shortest motion that tells a joint.
        min_margin: Smallest BIC difference between the two types.
        door_radius_m: A path is called straight only if an arc of this radius would stand out, [m].
        straight_sd: How far it has to stand out, in standard deviations.
    """

    noise: JointNoise = field(default_factory=JointNoise)
    nodes: int = 24
    smooth: int = 11
    min_turn_rad: float = float(np.radians(15.0))
    min_travel_m: float = 0.03
    min_margin: float = 3.0
    door_radius_m: float = 0.6
    straight_sd: float = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class JointEstimate:
    """A joint and its quality.

    Attributes:
        joint: Value 0 at the beginning of the path; `upper` is the observed travel.
        grasp_ee: The held point (3,), end-effector frame, refined, [m].
        axis_sd_rad: Standard deviation of the direction, [rad].
        origin_sd_m: Standard deviation of the axis line near the contact, [m].
        axis_ci95_rad, origin_ci95_m: Radii around direction and line that hold the true ones with 95 %.
        residual_m: RMS distance of the path from the model, [m].
        turn_ratio: Turn of the hand over turn of the part; 0 for a prismatic joint.
        margin: BIC of the other type minus BIC of this one.
    """

    joint: Joint
    grasp_ee: Array
    axis_sd_rad: float
    origin_sd_m: float
    axis_ci95_rad: float
    origin_ci95_m: float
    residual_m: float
    turn_ratio: float
    margin: float

    def __post_init__(self) -> None:
        freeze(self, "grasp_ee", self.grasp_ee, (3,))


def estimate_joint(
    Ts_world_ee: Array, grasp_ee: Array, edges: EdgePrior | None = None, params: JointParams | None = None
) -> JointEstimate:
    """Find the joint from the hand's poses while it holds the part.

    Args:
        Ts_world_ee: End-effector poses (T, 4, 4) from the start to the end of the motion, in order.
        grasp_ee: First guess of the held point (3,), end-effector frame, [m].
        edges: The object's box edges, or None to use the path alone.
        params: Limits and assumed errors.

    Returns:
        The joint, axis positive in the direction of the demonstration.

    Raises:
        DemonstrationTooShortError: Less than 15 degrees or 3 cm were shown.
        AmbiguousJointError: Both joint types explain the path equally well.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling"; the path fit replaces its edge decision,
    the edges remain as a prior. Not checked: that the hand does not slide along the part.
    """
    params = params or JointParams()
    path = thin(Ts_world_ee, grasp_ee, nodes=params.nodes, smooth=params.smooth)
    points = path.points_world
    extent = float(np.linalg.norm(points - points[0], axis=1).max())
    if not extent >= params.min_travel_m:
        raise DemonstrationTooShortError(
            "joint",
            f"the hand moved the part {extent * 1e3:.0f} mm, need {params.min_travel_m * 1e3:.0f} mm",
            _REMEDY,
        )
    revolute, prismatic = _compete(path, edges, params.noise)
    best, other = sorted((revolute, prismatic), key=lambda solution: solution.bic)
    margin = other.bic - best.bic
    turn = abs(float(revolute.values[-1] - revolute.values[0]))
    if best is revolute and not turn >= params.min_turn_rad:
        limit = np.degrees(params.min_turn_rad)
        raise DemonstrationTooShortError(
            "joint", f"the part turned {np.degrees(turn):.1f} degrees, need {limit:.0f}", _REMEDY
        )
    if best is prismatic:
        _refuse_hidden_arc(extent, best.residual_m, params)
    if not margin >= params.min_margin:
        raise AmbiguousJointError(
            "joint",
            f"a revolute and a prismatic joint fit equally well (BIC differs by {margin:.1f}, need "
            f"{params.min_margin:.1f})",
            "record a longer motion or give the joint's type in the project",
        )
    return _estimate(path, best, "revolute" if best is revolute else "prismatic", margin)


# Radius that holds 95 % of a round Gaussian in the plane, over the root of its variance's trace.
_RADIUS_95 = float(np.sqrt(-np.log(0.05)))
_REMEDY = "record a longer demonstration"


def _refuse_hidden_arc(extent_m: float, residual_m: float, params: JointParams) -> None:
    """A straight path is evidence of a prismatic joint only where a door's arc would be seen."""
    bulge = extent_m**2 / (8 * params.door_radius_m)
    need = params.straight_sd * residual_m / np.sqrt(params.noise.independent_nodes)
    if not bulge >= need:
        raise AmbiguousJointError(
            "joint",
            f"the path of {extent_m * 1e3:.0f} mm is straight, but a door of {params.door_radius_m:.1f} m radius "
            f"would bend it by {bulge * 1e3:.1f} mm only, need {need * 1e3:.1f} mm",
            "record a longer motion or give the joint's type in the project",
        )


def _compete(path: HandPath, edges: EdgePrior | None, noise: JointNoise) -> tuple[Solution, Solution]:
    """Both explanations under one noise level: the assumed one, or what the better model leaves."""
    revolute, prismatic = solve_revolute(path, edges, noise), solve_prismatic(path, edges, noise)
    left = min(revolute.residual_m, prismatic.residual_m)
    if left > noise.position_sd_m:
        wider = replace(noise, position_sd_m=left)
        return solve_revolute(path, edges, wider), solve_prismatic(path, edges, wider)
    return revolute, prismatic


def _estimate(path: HandPath, solution: Solution, joint_type: JointType, margin: float) -> JointEstimate:
    travel = float(solution.values[-1] - solution.values[0])
    sign = 1.0 if travel >= 0 else -1.0
    joint = Joint(
        type=joint_type, axis=sign * solution.axis, origin=solution.origin, lower=0.0, upper=abs(travel)
    )
    ratio = 0.0
    if joint_type == "revolute":
        values = solution.values - solution.values[0]
        ratio = float(values @ (path.turns_world @ solution.axis) / (values @ values))
    return JointEstimate(
        joint=joint,
        grasp_ee=solution.grasp_ee,
        axis_sd_rad=solution.axis_sd_rad,
        origin_sd_m=solution.origin_sd_m,
        axis_ci95_rad=_RADIUS_95 * solution.axis_sd_rad,
        origin_ci95_m=_RADIUS_95 * solution.origin_sd_m,
        residual_m=solution.residual_m,
        turn_ratio=ratio,
        margin=margin,
    )
