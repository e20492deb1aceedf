"""Coverage and width of the joint's stated 95 % intervals, over many hidden joints."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from aomgen.api.joint import JointFit, estimate_joint
from aomgen.core.transforms import angle_between
from aomgen.core.values import Array
from aomgen.errors import EstimationError
from benchmarks.joint_hands import LOG_HZ
from benchmarks.joint_worlds import GRASP_SD_M, JointWorld, draw_world


@dataclass(frozen=True, slots=True, kw_only=True)
class IntervalRow:
    """Result of one world.

    Attributes:
        seed: Seed of the world.
        kind: Its joint type.
        loose: Whether its grasp was loose.
        axis: Error and stated radius of the direction, [deg].
        origin: The same of the axis line nearest the held point, [mm]; zeros for a prismatic joint.
        values: Share of the joint values within their bounds, all of them and the last one alone, 0..1.
        failure: "" or why there is no correct result: the error's name, or "wrong type".
    """

    seed: int
    kind: str
    loose: bool
    axis: tuple[float, float]
    origin: tuple[float, float]
    values: tuple[float, float]
    failure: str


def measure_world(seed: int) -> IntervalRow:
    """Estimate one world's joint."""
    world = draw_world(seed)
    nothing = (float("inf"), 0.0)
    kind = world.joint.type
    failure = ""
    try:
        fit = estimate_joint(
            world.Ts_world_ee,
            np.arange(len(world.thetas)) / LOG_HZ,
            grasp_ee=world.grasp_ee,
            grasp_sd_m=GRASP_SD_M,
            closing_ee=world.closing_ee,
            part_points=(world.points_static, world.points_moving),
        )
        failure = "" if fit.type == kind else "wrong type"
    except EstimationError as error:
        failure = type(error).__name__
    if failure:
        return IntervalRow(
            seed=seed,
            kind=kind,
            loose=world.loose,
            axis=nothing,
            origin=nothing,
            values=(0.0, 0.0),
            failure=failure,
        )
    axis_deg = float(np.degrees(angle_between(fit.joint.axis, world.joint.axis)))
    low, high = fit.theta_bounds.T
    held = (world.thetas >= low) & (world.thetas <= high)
    return IntervalRow(
        seed=seed,
        kind=kind,
        loose=world.loose,
        axis=(axis_deg, float(np.degrees(fit.axis_radius_rad))),
        origin=_origin(world, fit),
        values=(float(held.mean()), float(held[-1])),
        failure="",
    )


def _origin(world: JointWorld, fit: JointFit) -> tuple[float, float]:
    joint = world.joint
    if joint.type == "prismatic":
        return 0.0, 0.0
    near = joint.origin + joint.axis * ((world.held_world - joint.origin) @ joint.axis)
    gap = np.linalg.norm(np.cross(near - fit.joint.origin, fit.joint.axis))
    return 1e3 * float(gap), 1e3 * fit.origin_radius_m


def interval_figures(rows: list[IntervalRow]) -> list[dict[str, Any]]:
    """Compute one row per group of worlds: errors, coverage of the intervals, width over error.

    Failures count in `worlds` and `failures` only, as they state no interval.
    """
    groups: dict[str, Callable[[IntervalRow], bool]] = {
        "all": lambda row: True,
        "revolute": lambda row: row.kind == "revolute",
        "prismatic": lambda row: row.kind == "prismatic",
        "firm grasp": lambda row: not row.loose,
        "loose grasp": lambda row: row.loose,
    }
    lines = []
    for name, belongs in groups.items():
        mine = [row for row in rows if belongs(row)]
        answered = [row for row in mine if not row.failure]
        line: dict[str, Any] = {"worlds of": name, "worlds": len(mine), "failures": len(mine) - len(answered)}
        line |= _figures("axis", "deg", np.array([row.axis for row in answered]))
        turning = [row.origin for row in answered if row.kind == "revolute"]
        line |= _figures("origin", "mm", np.array(turning))
        values = np.mean([row.values for row in answered], axis=0) if answered else (None, None)
        line |= dict(zip(("values_held", "last_value_held"), values, strict=True))
        lines.append(line)
    return lines


def _figures(name: str, unit: str, pairs: Array) -> dict[str, float | None]:
    """Compute the coverage of errors and radii (N, 2)."""
    keys = (f"{name}_{unit}", f"{name}_{unit}_p90", f"{name}_held", f"{name}_width")
    if not len(pairs):
        return dict.fromkeys(keys)
    errors, radii = pairs.T
    median = float(np.median(errors))
    held = float(np.mean(errors <= radii))
    figures = (median, float(np.percentile(errors, 90)), held, float(np.median(radii)) / median)
    return {key: round(value, 3) for key, value in zip(keys, figures, strict=True)}
