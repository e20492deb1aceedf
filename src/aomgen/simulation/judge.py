"""Decide whether a simulated run opens or closes the object by its handle: metrics, their limits, and rejections."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import JointType
from aomgen.core.plan import FittedAsset, Rejection, measure_excess
from aomgen.core.values import Array
from aomgen.core.verdict import Check, Setting, SettingOutcome
from aomgen.simulation.replay import SimulatedRun
from aomgen.simulation.scene import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PassRule:
    """Limits of an accepted run; correct runs of five categories use a third to two thirds of most limits.

    Attributes:
        target_share: Smallest ratio of the joint's travel to the planned travel.
        contact_share: Smallest share of the joint's progress during which a pad exerts force on the handle.
        contact_force_n: Smallest force that counts as contact, [N].
        min_revolute_rad, min_prismatic_m: Smallest planned travel, [rad] and [m].
        written_share: Largest part of the travel, relative to the planned travel, that is not the integral of the joint's
            velocity.
        start_share: Largest deviation from the planned first joint value before the robot touches the part, relative to
            the planned travel.
        pushed_share: Largest share of the joint's progress during which the robot pushes the part other than by pads on
            the handle.
        robot_force_n: Largest normal force of contacts of the robot other than the grasp, [N]: a grazing contact;
            collaborative arms stop at about 100 N.
        torque_share: Largest ratio of a drive's torque, averaged over `torque_s`, to its limit; a drive may reach its
            limit briefly when the commanded velocity changes.
        torque_s: Averaging time of the torque, [s]: the length of a frame at usual rates.
        tracking_mm: Largest distance between commanded and reached end effector, [mm]; corresponds to about 100 N at the
            stiffness of a usual arm.
        handle_penetration_mm: Largest penetration of gripper and handle, [mm]; pads are about 3 mm of rubber.
        penetration_mm: Largest penetration of the robot and other bodies, [mm].
        base_friction: Friction coefficient between the object and its support.
        drift_mm: Largest displacement of the base of an object that is not bolted, [mm].
    """

    target_share: float = 0.9
    contact_share: float = 0.8
    contact_force_n: float = 0.5
    min_revolute_rad: float = np.deg2rad(30.0)
    min_prismatic_m: float = 0.10
    written_share: float = 0.05
    start_share: float = 0.02
    pushed_share: float = 0.1
    robot_force_n: float = 15.0
    torque_share: float = 0.9
    torque_s: float = 0.1
    tracking_mm: float = 20.0
    handle_penetration_mm: float = 1.5
    penetration_mm: float = 1.0
    base_friction: float = 0.5
    drift_mm: float = 5.0

    def least_travel(self, joint_type: JointType) -> float:
        """Return the smallest planned travel of a joint type, [rad] or [m]."""
        return self.min_revolute_rad if joint_type == "revolute" else self.min_prismatic_m


def judge(
    run: SimulatedRun, fitted: FittedAsset, scene: Scene, setting: Setting, rule: PassRule
) -> SettingOutcome | Rejection:
    """Compare one run with the pass rule and with the planned motion of the object.

    Args:
        run: Simulated run.
        fitted: Object and its planned joint values.
        scene: Simulated scene.
        setting: Setting of the run.
        rule: Limits.

    Returns:
        The outcome with all metrics; or a Rejection with the reason of the first check that fails. Causes are checked
        before their consequences: "imposed", "moved_early", "door_pushed", "robot_contact", "torque", "tracking",
        "target", "contact", "penetration", "slides".
    """
    travel = fitted.travel
    forces = _forces(run, scene, float(np.sign(travel)))
    touched = np.flatnonzero(forces.part)
    first = int(touched[0]) if len(touched) else len(run.thetas)
    # Share of the planned travel that is completed at each tick.
    shares = (run.thetas - fitted.start_theta) / travel
    steps = np.maximum(np.diff(shares), 0.0)

    def progress(ticks: NDArray[np.bool_]) -> float:
        """Compute the share of the progress in steps that begin or end at one of these ticks."""
        return float(steps[ticks[:-1] | ticks[1:]].sum() / max(steps.sum(), 1e-9))

    holding = forces.pads >= rule.contact_force_n
    pushing = ~holding & (forces.pushing >= rule.contact_force_n)
    explained = float(((run.rates[:-1] + run.rates[1:]) / 2).sum() * run.tick_s)
    written = abs(float(run.thetas[-1] - run.thetas[0]) - explained) / abs(travel)

    def check(reason: str, figure: str, value: float, *, least: bool = False) -> Check:
        return Check(
            reason=reason, figure=figure, value=float(value), limit=getattr(rule, figure), least=least
        )

    checks = [
        check("imposed", "written_share", written),
        check("moved_early", "start_share", np.abs(shares[: max(first, 1)]).max()),
        check("door_pushed", "pushed_share", progress(pushing)),
        check("robot_contact", "robot_force_n", forces.strange.max()),
        check("torque", "torque_share", _torque_share(run, scene, rule.torque_s)),
        check("tracking", "tracking_mm", _tracking_mm(run, scene)),
        check("target", "target_share", shares[-1], least=True),
        check("contact", "contact_share", progress(holding), least=True),
        check("penetration", "handle_penetration_mm", forces.handle_depth_mm),
        check("penetration", "penetration_mm", forces.depth_mm),
    ]
    if not scene.bolted:
        drift_mm = 1000 * np.linalg.norm(run.bases_world - run.bases_world[0], axis=1).max()
        checks.append(check("slides", "drift_mm", drift_mm))
    for item in checks:
        if not item.passed:
            detail = f"{item.figure} is {item.value:.3g}, limit {item.limit:.3g} (setting {setting.name})"
            metrics = {other.figure: other.value for other in checks}
            excess = measure_excess(item.value, item.limit)
            return Rejection(reason=item.reason, detail=detail, metrics=metrics, excess=excess)
    first_held, last_held = np.flatnonzero(holding)[[0, -1]]
    return SettingOutcome(
        setting=setting,
        final_theta=float(run.thetas[-1]),
        peak_force_n=float(forces.pads.max()),
        peak_reaction_n=float(forces.reactions.max()),
        hold_s=(float(first_held * run.tick_s), float(last_held * run.tick_s)),
        hold_thetas=(float(run.thetas[first_held]), float(run.thetas[last_held])),
        checks=tuple(checks),
    )


@dataclass(frozen=True, slots=True)
class _Forces:
    """Sums of the robot's contact forces at every tick (N,), [N], and the deepest overlaps, [mm].

    Attributes:
        pads: Normal forces of pads on the handle, or on the moving part if it has no handle.
        part: Normal forces on the moving part.
        pushing: Normal forces on the moving part in the planned direction, without those in `pads`.
        strange: Normal forces of all contacts other than gripper on handle and pads on the moving part.
        reactions: Horizontal force on the object.
        handle_depth_mm: Overlap of gripper and handle.
        depth_mm: Overlap of the robot and other bodies.
    """

    pads: Array
    part: Array
    pushing: Array
    strange: Array
    reactions: Array
    handle_depth_mm: float
    depth_mm: float


def _forces(run: SimulatedRun, scene: Scene, direction: float) -> _Forces:
    """Sum the contact forces of a run that is planned to move the joint in a direction, 1 or -1."""
    touches, roles, joint = run.touches, scene.roles, scene.joint_world
    part = roles.moving[touches.other_geoms]
    handle = roles.handle[touches.other_geoms] if roles.handle.any() else part
    pads = roles.finger[touches.robot_geoms] >= 0
    grip, holding = roles.gripper[touches.robot_geoms] & handle, pads & handle
    on_object = -touches.forces_world
    moments = on_object
    if joint.type == "revolute":
        moments = np.cross(touches.points_world - joint.origin, on_object)
    onward = direction * (moments @ joint.axis) > 0

    def sums(values: Array) -> Array:
        return np.bincount(touches.ticks, values, len(run.thetas)).astype(np.float64)

    level = on_object[:, :2] * roles.object[touches.other_geoms, None]
    depths_mm = -1000 * touches.distances
    return _Forces(
        pads=sums(touches.forces * holding),
        part=sums(touches.forces * part),
        pushing=sums(touches.forces * (part & ~holding & onward)),
        strange=sums(touches.forces * ~(grip | pads & part)),
        reactions=np.hypot(sums(level[:, 0]), sums(level[:, 1])),
        handle_depth_mm=float(depths_mm[grip].max(initial=0.0)),
        depth_mm=float(depths_mm[~grip].max(initial=0.0)),
    )


def _torque_share(run: SimulatedRun, scene: Scene, seconds: float) -> float:
    """Compute the largest ratio of a drive's torque to its limit, as a moving average over a time, [s]."""
    count = max(round(seconds / run.tick_s), 1)
    total = np.cumsum(np.abs(run.torques) / scene.arm.torques, axis=0)
    return float((total[count:] - total[:-count]).max(initial=0.0) / count)


def _tracking_mm(run: SimulatedRun, scene: Scene) -> float:
    """Compute the distance between commanded and reached end effector at the five ticks with the largest joint error, [mm]."""
    worst = np.unique(np.argsort(np.abs(run.commands - run.joints).max(1))[-5:])
    commanded = scene.robot.ee_poses(run.commands[worst])[:, :3, 3]
    return float(1000 * np.linalg.norm(commanded - run.Ts_world_ee[worst, :3, 3], axis=1).max())
