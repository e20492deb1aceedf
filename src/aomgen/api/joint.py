"""Estimation of an object's joint from the path of the end effector that moved it."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from aomgen.api.arguments import require_array, require_poses, require_times
from aomgen.core.joint import Joint, JointType
from aomgen.core.transforms import ROTATION_TOLERANCE
from aomgen.core.values import Array, freeze_arrays
from aomgen.errors import ConfigError
from aomgen.motion.ee_path import GraspGuess
from aomgen.motion.joint_estimation import estimate_joint as estimate_from_path
from aomgen.motion.joint_value import YIELD_M, compute_path_value_sd, compute_path_values
from aomgen.motion.part_shape import measure_shape

# Half width of the 95 % interval of a standard normal distribution.
DEVIATE_95 = 1.96


@dataclass(frozen=True, slots=True, kw_only=True)
class JointFit:
    """The joint that explains an end effector's path, with its uncertainty.

    Attributes:
        joint: Type, axis, and a point on the axis, world frame; value 0 is the first pose, `upper` is the travel.
        times_s: Times of the poses (T,), [s].
        thetas: Joint value at each time (T,), [rad] or [m].
        theta_bounds: 95 % intervals (T, 2) of the values.
        axis_radius_rad: Angle around the estimated axis that contains the true direction with a probability of 95 %,
            [rad].
        origin_radius_m: Distance from the estimated axis line, near the gripper, within which the true line is with a
            probability of 95 %, [m]; 0 for a prismatic joint.
        log_evidence_ratio: Natural logarithm of the evidence of this joint type over that of the other type.
        grasp_ee: Point of the part that the gripper holds (3,), end-effector frame, [m].
    """

    joint: Joint
    times_s: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    theta_bounds: Annotated[Array, "T 2"]
    axis_radius_rad: float
    origin_radius_m: float
    log_evidence_ratio: float
    grasp_ee: Annotated[Array, "3"]

    __post_init__ = freeze_arrays

    @property
    def type(self) -> JointType:
        """ "revolute" or "prismatic"."""
        return self.joint.type


def estimate_joint(
    Ts_world_ee: ArrayLike,
    times_s: ArrayLike,
    *,
    grasp_ee: ArrayLike = (0.0, 0.0, 0.0),
    grasp_sd_m: float = 0.008,
    closing_ee: ArrayLike | None = None,
    part_points: tuple[ArrayLike, ArrayLike] | None = None,
) -> JointFit:
    """Estimate a joint's type, axis, origin and values from the path of the end effector that moved its part.

    The gripper may slip on the handle and follow its rotation only partly. The parameters of this noise are
    marginalized, so the bounds include it. They also include the compliance of the grasp.

    Args:
        Ts_world_ee: End-effector poses (T, 4, 4) from the first to the last moment in which the part moves.
        times_s: Times of the poses (T,), strictly increasing, [s].
        grasp_ee: Initial value of the held point (3,), end-effector frame, [m]; the default is the end effector's
            origin.
        grasp_sd_m: Standard deviation of this value in each direction, [m].
        closing_ee: Unit direction (3,) in which two fingers press on the part, end-effector frame; None if the gripper
            only pushes or hooks.
        part_points: Points (N, 3) and (M, 3) on the static and on the moving part, world frame at the first pose, [m].
            Their shape gives a prior of the axis (a hinge is on an edge of the part). None uses the path alone.

    Raises:
        ConfigError: An argument has another shape, or a pose is not rigid; the subclass indicates the problem.
        NonFiniteError: A number is NaN or infinite.
        DemonstrationTooShortError: The part moved less than 3 cm, or turned less than 15 degrees.
        AmbiguousJointError: Both joint types explain the path equally well.

    Source: AOMGen, sec. 4.2, "Articulated Object Modeling"; the edges, by which the paper decides, are a prior of the
    path fit here.

    Example:
        A door of 0.4 m radius turns by 1 rad about the vertical axis through (0.6, 0.2, 0), and the gripper turns
        along with it by half of that:

        >>> angles = np.linspace(0, 1, 50)
        >>> Ts = np.tile(np.eye(4), (50, 1, 1))
        >>> Ts[:, :3, 3] = np.stack([0.6 + 0.4 * np.sin(angles), 0.2 - 0.4 * np.cos(angles), 0.3 + 0 * angles], 1)
        >>> Ts[:, 0, 0] = Ts[:, 1, 1] = np.cos(angles / 2)
        >>> Ts[:, 1, 0] = np.sin(angles / 2); Ts[:, 0, 1] = -np.sin(angles / 2)
        >>> fit = ag.estimate_joint(Ts, times_s=np.arange(50) / 10, closing_ee=(1, 0, 0))
        >>> fit.type, np.round(np.abs(fit.joint.axis), 2).tolist()
        ('revolute', [0.0, 0.0, 1.0])
        >>> bool(abs(fit.thetas[-1] - 1) < 0.05)
        True
    """
    poses = require_poses("Ts_world_ee", Ts_world_ee)
    times = require_times("times_s", times_s, len(poses))
    if not (np.isfinite(grasp_sd_m) and grasp_sd_m > 0):
        raise ConfigError("grasp_sd_m", f"is {grasp_sd_m}", "pass a positive number of meters")
    hold = GraspGuess(
        point_ee=require_array("grasp_ee", grasp_ee, (3,)),
        closing_ee=None if closing_ee is None else _require_direction("closing_ee", closing_ee),
        sd_m=grasp_sd_m,
    )
    shape = None
    if part_points is not None:
        static, moving = (
            require_array(f"part_points[{k}]", points, (None, 3)) for k, points in enumerate(part_points)
        )
        shape = measure_shape(static, moving)
    found = estimate_from_path(poses, hold, shape)
    thetas = compute_path_values(found.joint, poses, found.grasp_ee, 0)
    sd = compute_path_value_sd(found, poses, thetas, yield_m=YIELD_M[found.joint.type])
    return JointFit(
        joint=found.joint,
        times_s=times,
        thetas=thetas,
        theta_bounds=np.stack([thetas - DEVIATE_95 * sd, thetas + DEVIATE_95 * sd], 1),
        axis_radius_rad=found.axis_ci95_rad,
        origin_radius_m=found.origin_ci95_m,
        log_evidence_ratio=found.margin / 2,
        grasp_ee=found.grasp_ee,
    )


def _require_direction(name: str, value: ArrayLike) -> Array:
    direction = require_array(name, value, (3,))
    length = float(np.linalg.norm(direction))
    if not abs(length - 1) < ROTATION_TOLERANCE:
        raise ConfigError(name, f"has length {length:.3g}", "pass a unit vector")
    return direction / length
