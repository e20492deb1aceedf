"""Tier B: an episode counts only when contact opens the object in every simulated setting."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from aomgen.assets.mjcf import (
    ARMATURE,
    CONTACT_FRICTION,
    GRAVITY,
    HOLDING_SOLIMP,
    RESISTANCES,
    JointResistance,
    holding_friction,
)
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, Rejection, SettingOutcome, Verdict, VerifiedEpisode
from aomgen.core.values import Array
from aomgen.simulation.replay import CONTROL_HZ, SETTLE_S, SimulatedRun, simulate
from aomgen.simulation.scene import Scene

CONTROL: Final = (
    "from frame t on the position command moves straight from action[t-1] to action[t], reached at t+1, with "
    "velocity feed-forward; the arm is gravity compensated; before frame 0 it stands at state[0]"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PassRule:
    """When a run counts.

    Attributes:
        target_share: Final joint value over the planned one, at least.
        contact_share: Share of the progress made while a pad carries force, at least.
        contact_force_n: What counts as carrying force, [N].
        min_revolute_rad, min_prismatic_m: Smallest planned final value.
        max_start_share: Joint value before the hand arrives, over the target, at most.
        base_friction: Coefficient between the object and its support.
        max_drift_m: Way the base of an object that is not bolted may slide, [m].
    """

    target_share: float = 0.9
    contact_share: float = 0.8
    contact_force_n: float = 0.5
    min_revolute_rad: float = np.deg2rad(30.0)
    min_prismatic_m: float = 0.10
    max_start_share: float = 0.02
    base_friction: float = 0.5
    max_drift_m: float = 0.005


def verify_plan(plan: EpisodePlan, scene: Scene) -> VerifiedEpisode | Rejection:
    """Simulate a plan in all settings (`RESISTANCES`) and keep what the nominal one, the first, reached.

    The plan's target, its final joint value, is fixed before any simulation; the scene's asset is moved to its pose.

    Returns:
        The episode with its verdict; or a Rejection "target_too_small", "diverged", "pre_opened",
        "target", "contact" or "slides", of the first setting that failed.

    Not checked: whether the real object's resistance lies within the settings.
    """
    rule, joint_type = PassRule(), plan.fitted.asset.joint.type
    minimum = rule.min_revolute_rad if joint_type == "revolute" else rule.min_prismatic_m
    target = plan.fitted.target_theta
    if not target >= minimum:
        return Rejection(
            reason="target_too_small",
            detail=f"planned final joint value is {target:.3f}, limit {minimum:.3f}",
            metrics={"target_theta": target},
        )
    outcomes: list[SettingOutcome] = []
    runs: list[SimulatedRun] = []
    for setting in RESISTANCES[joint_type]:
        placed = scene.placed(plan.T_world_object, damping=setting.damping, frictionloss=setting.frictionloss)
        run = simulate(placed, plan.joints, plan.gripper, plan.fps)
        if isinstance(run, Rejection):
            return run
        outcome = judge(run, target, placed, setting, rule)
        if isinstance(outcome, Rejection):
            return outcome
        outcomes.append(outcome)
        runs.append(run)
    verdict = Verdict(
        target_theta=target, outcomes=tuple(outcomes), kinematic=plan.metrics, bolted=scene.bolted
    )
    return _episode(plan, runs[0], verdict)


def judge(
    run: SimulatedRun, target: float, scene: Scene, setting: JointResistance, rule: PassRule
) -> SettingOutcome | Rejection:
    """Hold one run against the pass rule; the target is the planned final joint value, [rad] or [m].

    Returns:
        The figures; or a Rejection "pre_opened", "target", "contact" or "slides".
    """
    carrying = run.pad_forces >= rule.contact_force_n
    first = int(np.argmax(carrying)) if carrying.any() else len(carrying) - 1
    before = float(np.abs(run.thetas[: first + 1]).max()) / target
    steps = np.maximum(np.diff(run.thetas), 0.0)
    # A step counts when a pad carries force at its beginning or at its end.
    touched = carrying[:-1] | carrying[1:]
    contact_share = float(steps[touched].sum() / max(steps.sum(), 1e-9))
    errors = run.commands - run.joints
    outcome = SettingOutcome(
        name=setting.name,
        damping=setting.damping,
        frictionloss=setting.frictionloss,
        final_theta=float(run.thetas[-1]),
        target_share=float(run.thetas[-1]) / target,
        contact_share=contact_share,
        peak_force_n=float(run.pad_forces.max()),
        peak_reaction_n=float(run.reactions.max()),
        tracking_mm=_tracking_mm(scene, run, errors),
    )
    mass = scene.asset.static.mass + scene.asset.moving.mass
    tests = [
        ("pre_opened", before <= rule.max_start_share, f"the part stood at {before:.0%} before contact"),
        ("target", outcome.target_share >= rule.target_share,
         f"reached {outcome.target_share:.0%} of the target, limit {rule.target_share:.0%}"),
        ("contact", contact_share >= rule.contact_share,
         f"{contact_share:.0%} of the progress was made in contact, limit {rule.contact_share:.0%}"),
        ("slides", scene.bolted or run.drift_m.max() <= rule.max_drift_m,
         f"the base slid {1000 * run.drift_m.max():.1f} mm"),
    ]  # fmt: skip
    metrics = {
        "target_share": outcome.target_share,
        "contact_share": contact_share,
        "start_share": before,
        "peak_reaction_n": outcome.peak_reaction_n,
        "friction_limit_n": rule.base_friction * mass * GRAVITY,
        "tracking_mm": outcome.tracking_mm,
    }
    for reason, passed, detail in tests:
        if not passed:
            return Rejection(reason=reason, detail=f"{detail} (setting {setting.name})", metrics=metrics)
    return outcome


def _tracking_mm(scene: Scene, run: SimulatedRun, errors: np.ndarray) -> float:
    """Distance between commanded and reached end effector at its worst joint error, [mm]."""
    worst = np.unique(np.argsort(np.abs(errors).max(1))[-5:])
    commanded = scene.robot.ee_poses(run.commands[worst])[:, :3, 3]
    return float(1000 * np.linalg.norm(commanded - run.Ts_world_ee[worst, :3, 3], axis=1).max())


def _episode(plan: EpisodePlan, run: SimulatedRun, verdict: Verdict) -> VerifiedEpisode:
    ticks, touched = run.frame_ticks, run.contacts
    kept = np.isin(touched.frames, ticks)
    contacts = ContactLog(
        frames=np.searchsorted(ticks, touched.frames[kept]),
        fingers=touched.fingers[kept],
        points_world=touched.points_world[kept],
        normals_world=touched.normals_world[kept],
        forces=touched.forces[kept],
    )
    return VerifiedEpisode(
        plan=plan,
        joints=run.joints[ticks],
        gripper=run.gripper[ticks],
        thetas=run.thetas[ticks],
        Ts_world_ee=run.Ts_world_ee[ticks],
        contacts=contacts,
        verdict=verdict,
    )


def assumptions(asset: ArticulatedAsset, joint_zeros_rad: Array, *, bolted: bool) -> dict[str, Any]:
    """What verification assumed, so that another simulator can repeat it: `simulation` in `episode.json`, SI units.

    Args:
        asset: As it was simulated, after scaling.
        joint_zeros_rad: All joints of the episode minus what the real arm reads there (J,).
        bolted: Its base was held by the world.
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
        "settings": [
            {
                "name": resistance.name,
                "joint_damping": resistance.damping,
                "joint_frictionloss": resistance.frictionloss + holding,
            }
            for resistance in RESISTANCES[asset.joint.type]
        ],
    }
