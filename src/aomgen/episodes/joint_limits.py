"""Limits of the arm's joints along a path: position, speed, acceleration and jerk."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import PHASES
from aomgen.core.plan import Rejection, measure_excess
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel

# Tolerance of a measured distance to a limit, [rad] or [m].
ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class IkLimits:
    """Limits that a solved path must keep.

    Arms state their largest speeds, few their accelerations: planners of such arms use 5 to 10 rad/s^2, and
    manufacturers that state a limit 7.5 to 20 rad/s^2. Above about 7 rad/s^2, near a straight elbow, the
    simulated drives of a UR5e reach their largest torque.

    Attributes:
        residual_mm, residual_deg: Largest distance to the requested pose.
        speed, slide_speed: Largest speed of a revolute and of a prismatic joint, [rad/s] and [m/s].
        acceleration, slide_acceleration: The same, [rad/s^2] and [m/s^2].
        jerk, slide_jerk: The same, [rad/s^3] and [m/s^3].
        limit_margin, slide_margin: Distance kept from their limits, [rad] and [m].
        iterations: Number of Gauss-Newton steps per pose.
    """

    residual_mm: float = 1.0
    residual_deg: float = 0.5
    speed: float = 2.6
    slide_speed: float = 1.0
    acceleration: float = 6.0
    slide_acceleration: float = 5.0
    jerk: float = 100.0
    slide_jerk: float = 50.0
    limit_margin: float = 0.02
    slide_margin: float = 0.002
    iterations: int = 12


def list_margins(robot: RobotModel, limits: IkLimits) -> Array:
    """Return the distance (J,) that each joint keeps from its limits, [rad] or [m]."""
    return np.where(robot.slides, limits.slide_margin, limits.limit_margin)


def keep_margins(robot: RobotModel, measured: Array, limits: IkLimits) -> Array:
    """Return the distances (J,) that joints keep from their limits, or less where measured joints (N, J) are closer."""
    closest = _measure_margins(robot, measured).min(0)
    return np.minimum(list_margins(robot, limits), closest - ROUNDING)


def check_margins(robot: RobotModel, joints: Array, required: Array) -> Rejection | None:
    """Return a Rejection "joint_limit" for the first of joints (T, J) closer to a limit than required (J,)."""
    margins = _measure_margins(robot, joints)
    broken = ~np.all(margins >= required, axis=1)
    if not broken.any():
        return None
    row = int(np.argmax(broken))
    worst = int(np.argmin(margins[row] - required))
    margin, needed = float(margins[row, worst]), float(required[worst])
    return Rejection(
        reason="joint_limit",
        detail=f"{robot.joint_names[worst]} is {margin:.3f} from its limit, need at least {needed:.3g}",
        metrics={"limit_margin": margin, "sample": float(row)},
        excess=measure_excess(margin, needed),
    )


def check_speed(
    joints: Array,
    fps: float,
    limits: IkLimits,
    slides: NDArray[np.bool_],
    phases: NDArray[np.int64],
) -> dict[str, float] | Rejection:
    """Check the largest speed, acceleration and jerk on a path (T, J) that begins and ends at rest.

    A jump counts as too fast. `slides` marks the prismatic joints (J,).

    Returns:
        Metrics `joint_speed`, `joint_acceleration`, `joint_jerk` in [rad/s] and so on; or a Rejection: "too_fast"
        if a speed is too large, else "too_jerky" for an acceleration or jerk. Its metrics `<phase>_share` are the
        factors by which each phase must be slowed down (at most 1: the phase is slow enough).
    """
    at_rest = np.pad(joints, ((2, 2), (0, 0)), mode="edge")
    needed, figures, reason, detail, excess = np.zeros(len(joints)), {}, "", "", 0.0
    for order, (name, limit, slide_limit) in enumerate(
        (
            ("speed", limits.speed, limits.slide_speed),
            ("acceleration", limits.acceleration, limits.slide_acceleration),
            ("jerk", limits.jerk, limits.slide_jerk),
        ),
        start=1,
    ):
        rates = np.abs(np.diff(at_rest, order, axis=0)) * fps**order
        shares = rates / np.where(slides, slide_limit, limit)
        figures[f"joint_{name}"] = float(rates.max())
        step, joint = np.unravel_index(int(shares.argmax()), shares.shape)
        if not shares[step, joint] <= 1.0 and not reason:
            reason = "too_fast" if order == 1 else "too_jerky"
            excess = float(shares[step, joint]) - 1.0
            detail = f"{name} of joint {joint + 1} is {rates[step, joint]:.1f}, limit {(slide_limit if slides[joint] else limit)}"
        # A rate is assigned to all samples from which it is computed.
        factors = shares.max(1) ** (1 / order)
        for shift in range(order + 1):
            rows = np.arange(len(factors)) + shift - 2
            inside = (rows >= 0) & (rows < len(joints))
            np.maximum.at(needed, rows[inside], factors[inside])
    if not reason:
        return figures
    by_phase = {
        f"{phase}_share": float(needed[phases == index].max(initial=0.0))
        for index, phase in enumerate(PHASES)
    }
    return Rejection(reason=reason, detail=detail, metrics={**figures, **by_phase}, excess=excess)


def _measure_margins(robot: RobotModel, joints: Array) -> Array:
    """Compute the distances (N, J) of joints (N, J) to their nearer limits, [rad] or [m]; negative beyond a limit."""
    low, high = robot.joint_limits.T
    return np.minimum(joints - low, high - joints)
