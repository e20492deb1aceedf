"""`python -m benchmarks replay`: success rate of replayed demonstrations (the paper's Table 1)."""

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.usd_write import write_usd
from aomgen.core.episode import PHASES
from aomgen.core.plan import EpisodePlan, Rejection, Variation, VerifiedEpisode
from aomgen.core.transforms import apply
from aomgen.episodes.ik import IkSolver, ik_solver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.record import episode_of
from aomgen.episodes.variations import Ranges, scale_fit
from aomgen.evaluation.evaluate import interval_95
from aomgen.io.artifact import read_json
from aomgen.io.atomic import write_json
from aomgen.results import ASSET_USD
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.simulation.episode_scene import episode_scene
from aomgen.simulation.scene import Scene
from aomgen.simulation.verify import verify_plan
from benchmarks.exported import (
    CONTACT_SHARE,
    EARLY_SHARE,
    OPENED_SHARE,
    Exported,
    Opening,
    Replay,
    exported_of,
)
from benchmarks.foreign_scene import foreign_scene
from benchmarks.reachability import can_hold
from benchmarks.recovered import Recovered, recover
from synthetic.world import DEFAULT_ROBOT

# A replayed joint value within this distance of the stored one counts as equal, [deg] and [mm].
NEAR: Final = {"deg": 3.0, "mm": 5.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Poses and sizes of the objects: both drawn uniformly and independently."""

    name: str
    ranges: Ranges = field(default_factory=Ranges)
    scales: tuple[float, float] = (1.0, 1.0)


# The paper's ranges, and two beyond.
PAPER: Final = Sweep(name="paper")
BEYOND: Final = (
    Sweep(name="scaled", scales=(0.6, 1.0)),
    Sweep(name="wide", ranges=Ranges(x_m=(-0.2, 0.2), y_m=(-0.2, 0.2), yaw_deg=(-90.0, 90.0))),
)


def draw(sweep: Sweep, category: str, seed: int, index: int) -> Variation:
    """Draw number `index` of a sweep's independent uniform samples."""
    rng = np.random.default_rng([seed, index, *category.encode(), *sweep.name.encode()])
    ranges = sweep.ranges
    x, y, yaw, scale = (
        float(rng.uniform(*limits)) for limits in (ranges.x_m, ranges.y_m, ranges.yaw_deg, sweep.scales)
    )
    return Variation(seed=seed, index=index, x=x, y=y, yaw=float(np.deg2rad(yaw)), scale=scale)


def measure(folder: Path, category: str, sweep: Sweep, seed: int, index: int) -> dict[str, Any]:
    """Measure the outcome of one draw, kept in a folder next to the category's recovered demonstration.

    Returns:
        `x`, `y`, `yaw_deg`, `scale`; `feasible` (see `reachability.can_hold`); `reason` and `detail` of tier
        A, empty when it passed; then `ik` and the results of `judge_exported`.
    """
    place = folder / category / sweep.name / f"{index:05d}"
    if place.with_suffix(".json").is_file():
        return read_json(place.with_suffix(".json"))
    robot, solver, recovered, scene = _workplace(folder, category, seed)
    drawn = draw(sweep, category, seed, index)
    # The asset is scaled here, so that no planner scales it again.
    variation = replace(drawn, scale=1.0)
    demo, fitted, usd = recovered.demo, recovered.fitted, folder / category / ASSET_USD
    if drawn.scale != 1.0:
        fitted = scale_fit(fitted, drawn.scale)
        scene = episode_scene(robot, fitted, demo, recovered.support, bolted=True)
        usd = place / ASSET_USD
        write_usd(fitted.asset, usd)
    rng = np.random.default_rng([seed, index])
    placed = scene.place_at(variation.place_at(fitted))
    params = PlanParams(fps=recovered.fps)
    plan = plan_episode(fitted, demo, variation, scene, solver, params)
    row: dict[str, Any] = {
        "x": variation.x,
        "y": variation.y,
        "yaw_deg": float(np.rad2deg(variation.yaw)),
        "scale": drawn.scale,
        "feasible": can_hold(placed, fitted, demo.joints[0], rng),
        "reason": "",
    }
    if isinstance(plan, Rejection):
        row |= asdict(plan)
    else:
        row |= {"grasp": plan.grasp, "ik": recheck(plan, robot, params)}
        row |= judge_exported(verify_plan(plan, scene), robot, usd)
    write_json(place.with_suffix(".json"), row)
    return row


@cache
def _workplace(folder: Path, category: str, seed: int) -> tuple[RobotModel, IkSolver, Recovered, Scene]:
    """Prepare the common data of all draws of a category."""
    robot, recovered = load_robot(DEFAULT_ROBOT), recover(category, seed, folder / category)
    scene = episode_scene(robot, recovered.fitted, recovered.demo, recovered.support, bolted=True)
    return robot, ik_solver(robot), recovered, scene


def judge_exported(verified: VerifiedEpisode | Rejection, robot: RobotModel, usd: Path) -> dict[str, Any]:
    """Replay a verified plan from its exported actions, its object's USD and its pose alone.

    Returns:
        `failure`: why tier B or a replay failed in one of the settings, else empty; `failure_detail`; of a
        verified one also `unit`, `theta_worst` (nominal replay against stored states), `near`, and
        `opened_when_moved` (the object AWAY_M farther).
    """
    if isinstance(verified, Rejection):
        return {"failure": verified.reason, "failure_detail": verified.detail}
    exported = exported_of(episode_of(verified, 0, usd, robot, "", {}, np.zeros(len(robot.joint_names))), usd)
    scene = foreign_scene(robot, usd, exported.T_world_object)
    runs = [Replay(scene, robot, exported, setting=k).run() for k in range(len(scene.resistances))]
    failures = [f"replay {why}" for run in runs if (why := judge_opening(run, exported))]
    unit, factor = ("deg", 180 / np.pi) if scene.revolute else ("mm", 1e3)
    errors = factor * np.abs(runs[0].thetas[:-1] - exported.thetas)
    away = exported.moved_away(robot)
    missed = Replay(foreign_scene(robot, usd, away.T_world_object), robot, away).run()
    return {
        "failure": failures[0] if failures else "",
        "failure_detail": ", ".join(failures),
        "unit": unit,
        "theta_worst": float(errors.max()),
        "near": bool(errors.max() <= NEAR[unit]),
        "opened_when_moved": bool(exported.shares(missed.thetas)[-1] >= OPENED_SHARE),
    }


def judge_opening(run: Opening, exported: Exported) -> str:
    """Return why a replay fails, by the same rule as verification; empty when it passes."""
    shares, carried = exported.shares(run.thetas), run.carried
    # Frames are coarse: at the first one with force the part may have moved already.
    first = int(np.argmax(carried)) if carried.any() else len(carried)
    if not np.abs(shares[:first]).max(initial=0.0) <= EARLY_SHARE:
        return "moved_early"
    if not shares[-1] >= OPENED_SHARE:
        return "target"
    steps = np.maximum(np.diff(shares), 0.0)
    if not steps[carried[:-1] | carried[1:]].sum() >= CONTACT_SHARE * steps.sum():
        return "contact"
    return ""


def recheck(plan: EpisodePlan, robot: RobotModel, params: PlanParams) -> dict[str, float]:
    """Check an exported plan by forward kinematics: contact of handle and gripper, and speed of the joints.

    Returns:
        `mm` and `deg`: largest deviation of the held point and of the bar's direction from their mean pose in
        the gripper during contact; `step`: largest joint step over the speed limit's step per frame.
    """
    joints, asset = plan.joints.astype(np.float32).astype(np.float64), plan.fitted.asset
    holding = plan.phases == PHASES.index("contact")
    Ts_world_ee = robot.ee_poses(joints[holding])
    Ts_world_part = plan.T_world_object @ asset.joint.motion(plan.thetas[holding])
    held = apply(Ts_world_part, plan.fitted.contact_asset[None]).reshape(-1, 3)
    points = np.einsum("tji,tj->ti", Ts_world_ee[:, :3, :3], held - Ts_world_ee[:, :3, 3])
    bars = np.einsum("tji,tj->ti", Ts_world_ee[:, :3, :3], Ts_world_part[:, :3, :3] @ asset.handle_axis)
    off, middle = points - np.median(points, axis=0), np.median(bars, axis=0)
    cosines = np.clip(bars @ middle / np.linalg.norm(middle), -1.0, 1.0)
    limit = np.where(robot.slides, params.ik.slide_speed, params.ik.speed) / plan.fps
    return {
        "mm": float(1000 * np.linalg.norm(off, axis=1).max()),
        "deg": float(np.rad2deg(np.arccos(cosines.min()))),
        "step": float((np.abs(np.diff(joints, axis=0)) / limit).max()),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Compute metrics of a sweep's draws; `docs/episodes.md` explains them."""
    planned = [row for row in rows if not row["reason"]]
    passed = [row for row in planned if not row["failure"]]
    verified = [row for row in planned if "unit" in row]
    feasible = sum(row["feasible"] for row in rows)
    figures: dict[str, Any] = {
        "drawn": len(rows),
        "feasible": feasible,
        "attempts": len(planned),
        "planned_share": len(planned) / feasible if feasible else None,
        "planned_though_infeasible": sum(not row["feasible"] for row in planned),
        "tier_a_reasons": _counts(rows, "reason"),
        "missed_reasons": _counts([row for row in rows if row["feasible"]], "reason"),
        "fail_reasons": _counts(planned, "failure"),
    }
    if planned:
        figures["success_rate"] = len(passed) / len(planned)
        figures["interval_95"] = interval_95(len(passed), len(planned))
        figures["ik"] = worst_ik(planned)
    if verified:
        figures["unit"] = verified[0]["unit"]
        figures["theta_worst"] = max(row["theta_worst"] for row in verified)
        figures["near_share"] = sum(row["near"] for row in verified) / len(verified)
        figures["opened_when_moved"] = sum(row["opened_when_moved"] for row in verified)
    return figures


def worst_ik(planned: list[dict[str, Any]]) -> dict[str, float]:
    """Compute the number of plans, and the largest of each metric of `recheck`."""
    worst = {name: max(row["ik"][name] for row in planned) for name in ("mm", "deg", "step")}
    return {"plans": float(len(planned)), **worst}


def _counts(rows: list[dict[str, Any]], name: str) -> dict[str, int]:
    return dict(Counter(row[name] for row in rows if row[name]).most_common())
