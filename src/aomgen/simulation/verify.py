"""Tier B of verification: accept an episode only if contact moves the object in every simulated setting."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import mujoco
import numpy as np

from aomgen.assets.mjcf import ARMATURE, CONTACT_FRICTION, HOLDING_SOLIMP, holding_friction
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import Trajectory
from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, Rejection, VerifiedEpisode, measure_excess
from aomgen.core.values import Array
from aomgen.core.verdict import Check, Setting, SettingOutcome, Verdict
from aomgen.simulation.collision_check import KinematicLimits
from aomgen.simulation.controls import CONTROL_HZ, SETTLE_S
from aomgen.simulation.judge import PassRule, judge
from aomgen.simulation.replay import SimulatedRun, simulate
from aomgen.simulation.scene import Scene
from aomgen.simulation.settings import draw_settings
from aomgen.version import __version__

CONTROL: Final = (
    "from frame t on the position command moves straight from action[t-1] to action[t], reached at t+1, with "
    "velocity feed-forward; the arm is gravity compensated; before frame 0 it stands at state[0]; if push_m of the "
    "variation is more than 0, the simulated command also contained the random pushes, which the actions omit"
)
JOINT_DRIVES = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def verify_plan(
    plan: EpisodePlan,
    scene: Scene,
    *,
    commanded: Array | None = None,
    limits: Mapping[str, float] | None = None,
    digests: Mapping[str, str] | None = None,
) -> VerifiedEpisode | Rejection:
    """Simulate a plan in the settings that are sampled for it, and record the states of the last one, the nominal setting.

    The planned first and final joint values are fixed before any simulation. All settings are equal until the robot touches
    the object, so only the first one is simulated from the start if the object is bolted. (The rest position of a lid that
    its hinge's friction holds differs by at most 1e-4 rad between the settings.)

    Args:
        plan: Plan that passed tier A.
        scene: Scene with the plan's asset, which is moved to the planned pose.
        commanded: Arm joints (T, J) that are commanded instead of those of the plan.
        limits: Limits of tier A by the names of the plan's metrics; by default those of `KinematicLimits`.
        digests: SHA-256 of the plan's inputs, by name, for the certificate.

    Returns:
        The episode with its verdict; or a Rejection "target_too_small", "not_finite", "imposed" or "diverged", or the
        rejection of `judge` for the first setting that failed.

    Not checked: whether the real object's resistance is within the range of the settings; self-contacts of the robot.
    """
    rule, fitted, asset = PassRule(), plan.fitted, plan.fitted.asset
    minimum, travel = rule.least_travel(asset.joint.type), abs(fitted.travel)
    if not travel >= minimum:
        return Rejection(
            reason="target_too_small",
            detail=f"planned travel of the joint is {travel:.3f}, limit {minimum:.3f}",
            metrics={"travel": travel},
            excess=measure_excess(travel, minimum),
        )
    if not (np.isfinite(plan.joints).all() and np.isfinite(plan.gripper).all()):
        return Rejection(reason="not_finite", detail="an action is not a number")
    drive = find_drive(scene)
    if drive:
        return Rejection(reason="imposed", detail=f"{drive} moves the object's joint")
    placed, variation = scene.place_at(plan.T_world_object), plan.variation
    outcomes: list[SettingOutcome] = []
    runs: list[SimulatedRun] = []
    for setting in draw_settings(asset, variation.seed, variation.index):
        # An object that is not bolted settles differently in each setting, because its mass differs.
        approach = runs[0] if runs and scene.bolted else None
        run = simulate(
            placed,
            plan.joints if commanded is None else commanded,
            plan.gripper,
            plan.fps,
            setting=setting,
            approach=approach,
            initial_theta=fitted.start_theta,
        )
        if isinstance(run, Rejection):
            return run
        outcome = judge(run, fitted, placed, setting, rule)
        if isinstance(outcome, Rejection):
            return outcome
        outcomes.append(outcome)
        runs.append(run)
    verdict = Verdict(
        start_theta=fitted.start_theta,
        target_theta=fitted.target_theta,
        outcomes=tuple(outcomes),
        kinematic=_kinematic_checks(plan.metrics, limits),
        bolted=scene.bolted,
        seed=variation.seed,
        index=variation.index,
        versions={"aomgen": __version__, "mujoco": mujoco.__version__, "numpy": np.__version__},
        digests={**(digests or {}), "actions": _digest_actions(plan)},
    )
    return _episode(plan, runs[-1], placed, verdict)


def find_drive(scene: Scene) -> str:
    """Describe a model element, other than contact, that could move the object's joint; empty if the joint is passive."""
    model, names = scene.model, scene.names
    joint = model.joint(names.joint).id
    bodies = [model.body(name).id for name in (names.static_body, names.moving_body)]
    if model.jnt_stiffness[joint] != 0:
        return "a spring"
    driven = np.isin(model.actuator_trntype, JOINT_DRIVES) & (model.actuator_trnid[:, 0] == joint)
    if driven.any():
        return f"actuator {model.actuator(int(np.argmax(driven))).name}"
    if np.any((model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT) & (model.wrap_objid == joint)):
        return "a tendon"
    ends = np.stack([model.eq_obj1id, model.eq_obj2id], -1)
    tied = np.zeros(model.neq, bool)
    sites = np.flatnonzero(np.isin(model.site_bodyid, bodies))
    kinds = {
        mujoco.mjtObj.mjOBJ_JOINT: [joint],
        mujoco.mjtObj.mjOBJ_BODY: bodies,
        mujoco.mjtObj.mjOBJ_SITE: sites,
    }
    for kind, ids in kinds.items():
        tied |= (model.eq_objtype == kind) & np.isin(ends, ids).any(-1)
    return f"constraint {model.equality(int(np.argmax(tied))).name}" if tied.any() else ""


def _kinematic_checks(metrics: Mapping[str, float], limits: Mapping[str, float] | None) -> tuple[Check, ...]:
    """Convert tier A's metrics that have a limit to checks, which have no reason of rejection because they have passed."""
    limits = KinematicLimits().by_figure if limits is None else limits
    return tuple(
        Check(reason="", figure=name, value=value, limit=limits[name])
        for name, value in sorted(metrics.items())
        if name in limits
    )


def _digest_actions(plan: EpisodePlan) -> str:
    """Compute the SHA-256 of the planned joints and gripper, row by row as little-endian float64."""
    actions = np.column_stack([plan.joints, plan.gripper]).astype("<f8")
    return hashlib.sha256(actions.tobytes()).hexdigest()


def _episode(plan: EpisodePlan, run: SimulatedRun, scene: Scene, verdict: Verdict) -> VerifiedEpisode:
    """Build the episode from the states that a run reached at the plan's samples, and from the pads' contacts."""
    ticks, touches, roles = run.frame_ticks, run.touches, scene.roles
    fingers = roles.finger[touches.robot_geoms]
    kept = (fingers >= 0) & roles.moving[touches.other_geoms] & (touches.forces > 0)
    kept &= np.isin(touches.ticks, ticks)
    contacts = ContactLog(
        frames=np.searchsorted(ticks, touches.ticks[kept]),
        fingers=fingers[kept],
        points_world=touches.points_world[kept],
        normals_world=touches.normals_world[kept],
        forces=touches.forces[kept],
    )
    return VerifiedEpisode(
        plan=plan,
        reached=Trajectory(
            times_s=plan.times_s,
            joints=run.joints[ticks],
            gripper=run.gripper[ticks],
            thetas=run.thetas[ticks],
        ),
        contacts=contacts,
        verdict=verdict,
    )


def assumptions(
    asset: ArticulatedAsset, settings: tuple[Setting, ...], joint_zeros_rad: Array, *, bolted: bool
) -> dict[str, Any]:
    """List the assumptions of verification for other simulators, in SI units: `simulation` in `episode.json`.

    Args:
        asset: Simulated asset, after scaling.
        settings: Simulated settings; the states of the episode are those of the last one.
        joint_zeros_rad: Joint values of the episode minus the readings of the real arm in the same pose (J,).
        bolted: The object's base was fixed to the world.
    """
    holding = holding_friction(asset)
    return {
        "control": CONTROL,
        "control_hz_at_least": CONTROL_HZ,
        "settle_s": SETTLE_S,
        "joint_zeros_rad": joint_zeros_rad.tolist(),
        "bolted": bolted,
        "masses_kg": {"static": asset.static.mass, "moving": asset.moving.mass},
        "contact_friction": list(CONTACT_FRICTION),
        "joint_armature": ARMATURE,
        "joint_holding_friction": holding,
        "joint_solimp_friction": list(HOLDING_SOLIMP) if holding else None,
        "settings": [asdict(setting) for setting in settings],
    }
