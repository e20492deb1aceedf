"""Tier A of verification: check without dynamics that a trajectory avoids collisions and grasps the handle."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.demonstration import Trajectory
from aomgen.core.plan import Rejection, measure_excess
from aomgen.core.transforms import matrix_from_quat
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene

# Largest motion of any point between two consecutive checked configurations, [m].
SWEEP_M = 0.005
# Margin to the limits that configurations of a path search keep, [mm], because the path is smoothed afterwards.
SEARCH_RESERVE_MM = 0.5
# Assumed largest ratio between the length of a point's path and the chord between its samples.
SWEEP_RESERVE = 1.25
# Number of bisections of the gripper's stroke that locate the opening at which it stalls on the handle, to 0.5 mm.
STALL_STEPS = 8
# Kinds of overlaps: ignored, between robot (or moving part) and scene, between robot links, between gripper and handle.
NOTHING, SCENE, SELF, HANDLE = range(4)


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicLimits:
    """Largest overlaps and largest gap that tier A accepts.

    Attributes:
        max_penetration_mm: Overlap of robot and scene.
        max_handle_penetration_mm: Overlap of gripper and handle during the grasp.
        max_gap_mm: Distance between the handle and the farther finger's pads during the grasp.
        max_self_penetration_mm: Overlap of two robot links; `self_overlap_mm` of the recorded configurations is allowed in
            addition.
    """

    max_penetration_mm: float = 1.0
    max_handle_penetration_mm: float = 6.0
    max_gap_mm: float = 10.0
    max_self_penetration_mm: float = 1.0

    @property
    def by_figure(self) -> dict[str, float]:
        """Limits by the names of the metrics of `check_kinematics`, except for self-penetration."""
        return {
            "penetration_mm": self.max_penetration_mm,
            "handle_penetration_mm": self.max_handle_penetration_mm,
            "grip_gap_mm": self.max_gap_mm,
        }


def check_kinematics(
    scene: Scene,
    joints: Array,
    gripper: Array,
    thetas: Array,
    holding: NDArray[np.bool_],
    limits: KinematicLimits,
) -> dict[str, float] | Rejection:
    """Move robot and object along a trajectory of T samples, and measure overlaps and the grasp.

    Between two samples, all joints are interpolated linearly, as the simulator commands them. The configurations are close
    enough that no point of the robot or of the moving part travels farther than `SWEEP_M` between two of them.

    Args:
        scene: Scene with the object at its pose; a distance below the scene's clearances counts as overlap.
        joints: Arm joints (T, J), [rad] or [m].
        gripper: Gripper (T,), 0 open .. 1 closed, at the opening at which it stalls on the handle.
        thetas: Object joint (T,), [rad] or [m].
        holding: Mask (T,) of the samples in which the fingers are meant to touch the handle.
        limits: Largest accepted overlaps and gap.

    Returns:
        Metrics `penetration_mm`, `handle_penetration_mm`, `self_penetration_mm` and `grip_gap_mm`; or a Rejection
        "collision", "self_collision", "grip_collision" or "no_grip" whose metric `sample` is the worst sample.
    """
    result = _measure_motion(scene, joints, gripper, thetas, holding, limits)
    if not isinstance(result, Rejection):
        return result
    times = np.arange(len(joints), dtype=np.float64)
    motion = Trajectory(
        times_s=times, joints=joints, gripper=np.broadcast_to(gripper, times.shape), thetas=thetas
    )
    return replace(result, worst=motion.at([result.metrics["sample"]]))


def _measure_motion(
    scene: Scene,
    joints: Array,
    gripper: Array,
    thetas: Array,
    holding: NDArray[np.bool_],
    limits: KinematicLimits,
) -> dict[str, float] | Rejection:
    data, kinds = mujoco.MjData(scene.model), _pair_kinds(scene)
    worst = {"scene": _Overlap(*_object_overlap(scene, data)), "self": _Overlap(), "handle": _Overlap()}
    rows = np.arange(len(joints), dtype=np.float64)
    qpos = scene.qpos(joints, gripper, thetas)
    # The samples are checked first, because most collisions are already detected there.
    found, places = _sweep(scene, data, kinds, qpos, rows, holding)
    worst = {kind: max(worst[kind], found[kind]) for kind in worst}
    result = _judge(worst, _Overlap(), limits)
    if isinstance(result, Rejection):
        return result
    # Distances between the handle and the farther finger's pads; 0 for a robot without pads.
    gaps = [1000.0 * max(0.0, *_finger_gaps_m(scene, data, row)) for row in qpos[holding]]
    gap = _Overlap(max(gaps, default=0.0), float(np.flatnonzero(holding)[np.argmax(gaps)]) if gaps else 0.0)
    result = _judge(worst, gap, limits)
    if isinstance(result, Rejection):
        return result
    counts = np.ceil(_moves(scene, places) / SWEEP_M * SWEEP_RESERVE).astype(int)
    between = np.concatenate([k + np.arange(1, n) / n for k, n in enumerate(counts)] or [rows[:0]])
    before = between.astype(int)
    shares = (between - before)[:, None]
    swept = (1 - shares) * qpos[before] + shares * qpos[before + 1]
    found, _ = _sweep(scene, data, kinds, swept, between, holding)
    return _judge({kind: max(worst[kind], found[kind]) for kind in worst}, gap, limits)


def self_overlap_mm(scene: Scene, joints: Array, gripper: float) -> float:
    """Compute the largest overlap of robot links at joints (J,), [mm]; for the real arm, an error of the collision shapes."""
    qpos, still = scene.qpos(joints[None], gripper, 0.0), np.zeros(1)
    found, _ = _sweep(scene, mujoco.MjData(scene.model), _pair_kinds(scene), qpos, still, still > 0)
    return found["self"].mm


class _Overlap(NamedTuple):
    """An overlap of two bodies, [mm], its fractional sample, and the names of the bodies."""

    mm: float = 0.0
    sample: float = 0.0
    bodies: tuple[str, ...] = ()


def _judge(
    worst: dict[str, _Overlap], gap: _Overlap, limits: KinematicLimits
) -> dict[str, float] | Rejection:
    """Return the metrics, or a rejection for the first one that exceeds its limit."""
    tests = [
        ("collision", "penetration_mm", worst["scene"], limits.max_penetration_mm),
        ("self_collision", "self_penetration_mm", worst["self"], limits.max_self_penetration_mm),
        ("grip_collision", "handle_penetration_mm", worst["handle"], limits.max_handle_penetration_mm),
        ("no_grip", "grip_gap_mm", gap, limits.max_gap_mm),
    ]
    figures = {name: overlap.mm for _, name, overlap, _ in tests}
    for reason, name, overlap, limit in tests:
        if not overlap.mm <= limit:
            place = f" ({' and '.join(overlap.bodies)})" if overlap.bodies else ""
            return Rejection(
                reason=reason,
                detail=f"{name} is {overlap.mm:.1f}, limit {limit:.1f}{place}",
                metrics={**figures, "sample": overlap.sample},
                excess=measure_excess(overlap.mm, limit),
                bodies=overlap.bodies,
            )
    return figures


def _sweep(
    scene: Scene,
    data: mujoco.MjData,
    kinds: NDArray[np.int8],
    qpos: Array,
    rows: Array,
    holding: NDArray[np.bool_],
) -> tuple[dict[str, _Overlap], Array]:
    """Compute the deepest overlap of each kind over states (N, nq) at the trajectory's fractional samples `rows` (N,).

    The second result holds the poses (N, B, 12) of all bodies: rotation, then position.
    """
    model = scene.model
    places = np.empty((len(qpos), model.nbody, 12))
    pairs, depths, counts = [], [], np.zeros(len(qpos), np.int64)
    for index, row in enumerate(qpos):
        place_scene(scene, data, row)
        places[index, :, :9], places[index, :, 9:] = data.xmat, data.xpos
        if data.ncon:
            counts[index] = data.ncon
            pairs.append(np.array(data.contact.geom))
            depths.append(np.array(data.contact.dist))
    worst = {"scene": _Overlap(), "self": _Overlap(), "handle": _Overlap()}
    if not pairs:
        return worst, places
    touching, at = np.concatenate(pairs), np.repeat(rows, counts)
    mm = _depths_mm(scene, touching, np.concatenate(depths))
    # Contact with the handle is also allowed between two samples of which only one is part of the grasp.
    held = holding[np.floor(at).astype(int)] | holding[np.ceil(at).astype(int)]
    kind = kinds[touching[:, 0], touching[:, 1]]
    kind = np.where((kind == HANDLE) & ~held, SCENE, kind)
    for name, number in (("scene", SCENE), ("self", SELF), ("handle", HANDLE)):
        mine = np.where(kind == number, mm, 0.0)
        deepest = int(mine.argmax())
        if mine[deepest] > 0:
            # The robot's geom is the first of the pair.
            a, b = sorted(touching[deepest], key=lambda geom: not scene.roles.robot[geom])
            body_a, body_b = (model.body(model.geom_bodyid[geom]).name for geom in (a, b))
            bodies = (body_a, model.geom(int(b)).name or body_b)
            worst[name] = _Overlap(float(mine[deepest]), float(at[deepest]), bodies)
    return worst, places


def make_collision_test(
    scene: Scene,
    gripper: float,
    theta: float,
    limits: KinematicLimits,
    *,
    holding: bool = False,
    gripper_as_arm: bool = False,
) -> Callable[[Array], bool]:
    """Make a function that returns whether an arm configuration (J,) is free of collisions.

    Args:
        scene: Scene with the object at its pose.
        gripper, theta: Fixed values of the gripper, 0 open .. 1 closed, and of the object's joint, [rad] or [m].
        limits: Largest accepted overlaps; they are reduced by `SEARCH_RESERVE_MM`.
        holding: Ignore overlaps of gripper and handle.
        gripper_as_arm: Keep the clearance of the arm with the gripper as well.
    """
    data, kinds = mujoco.MjData(scene.model), _pair_kinds(scene)
    qpos = scene.qpos(np.zeros((1, len(scene.robot.joint_names))), gripper, theta)[0]
    limit, own = limits.max_penetration_mm, limits.max_self_penetration_mm
    deepest = np.array([np.inf, limit, own, np.inf if holding else limit]) - SEARCH_RESERVE_MM

    def is_free(joints: Array) -> bool:
        qpos[scene.arm.qpos] = joints
        place_scene(scene, data, qpos)
        if not data.ncon:
            return True
        pairs = data.contact.geom
        mm = _depths_mm(scene, pairs, data.contact.dist, gripper_as_arm)
        return bool((mm <= deepest[kinds[pairs[:, 0], pairs[:, 1]]]).all())

    return is_free


def _depths_mm(scene: Scene, pairs: NDArray[np.int32], distances: Array, as_arm: bool = False) -> Array:
    """Convert distances (N,), [m], of pairs (N, 2) to depths below the clearances (N,), [mm], with `as_arm` also for the gripper."""
    roles = scene.roles
    arm = roles.robot & (as_arm | ~roles.gripper)
    of_arm = roles.object[pairs].any(1) & arm[pairs].any(1)
    of_gripper = roles.static[pairs].any(1) & roles.gripper[pairs].any(1)
    kept = np.maximum(scene.clearance * of_arm, scene.gripper_clearance * of_gripper)
    return 1000.0 * (kept - distances)


def _held(scene: Scene) -> NDArray[np.bool_]:
    """Return the mask (G,) of the geoms that fingers hold: the handle, or the whole moving part if it has no handle."""
    return scene.roles.handle if scene.roles.handle.any() else scene.roles.moving


def _pair_kinds(scene: Scene) -> NDArray[np.int8]:
    """Return the kind of overlap (G, G) of every pair of geoms."""
    roles = scene.roles
    robot, hand = roles.robot, roles.gripper
    kinds = np.zeros((len(robot), len(robot)), np.int8)
    kinds[robot[:, None] ^ robot] = SCENE
    kinds[robot[:, None] & robot & ~(hand[:, None] & hand)] = SELF
    for a, b, kind in ((hand, _held(scene), HANDLE), (roles.moving, roles.obstacle, SCENE)):
        pairs = a[:, None] & b
        kinds[pairs | pairs.T] = kind
    return kinds


def _object_overlap(scene: Scene, data: mujoco.MjData) -> tuple[float, float, tuple[str, ...]]:
    """Compute the overlap of the object's static link with obstacles, [mm]; MuJoCo does not test pairs of static bodies."""
    static, obstacles = np.flatnonzero(scene.roles.static), np.flatnonzero(scene.roles.obstacle)
    if not len(obstacles):
        return 0.0, 0.0, ()
    mujoco.mj_kinematics(scene.model, data)
    distances = {
        (a, b): mujoco.mj_geomDistance(scene.model, data, int(a), int(b), 0.1, None)
        for a, b in product(static, obstacles)
    }
    (a, b), distance = min(distances.items(), key=lambda item: item[1])
    bodies = (scene.model.geom(int(a)).name, scene.model.geom(int(b)).name)
    return max(0.0, -1000.0 * distance), 0.0, bodies


def _moves(scene: Scene, places: Array) -> Array:
    """Compute the largest motion of any point of robot or moving part (N - 1,), [m], between body poses (N, B, 12)."""
    model = scene.model
    solid = np.flatnonzero(scene.roles.robot | scene.roles.moving)
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    # Under a rigid motion, the largest displacement of a box occurs at one of its corners.
    corners = model.geom_aabb[solid, None, :3] + signs * model.geom_aabb[solid, None, 3:]
    turns = matrix_from_quat(model.geom_quat[solid])
    corners = np.einsum("gij,gkj->gki", turns, corners) + model.geom_pos[solid, None]
    poses = places[:, model.geom_bodyid[solid]]
    steps = np.diff(poses, axis=0)
    shifts = corners @ steps[..., :9].reshape(*steps.shape[:2], 3, 3).swapaxes(2, 3) + steps[..., None, 9:]
    return np.sqrt((shifts**2).sum(-1).max((1, 2)))


def holding_gripper(robot: RobotModel, width_m: float, fallback: float) -> float:
    """Compute the gripper value 0..1 at which the distance of the pads is `width_m`; `fallback` for a robot without pads."""
    values = np.linspace(0.0, 1.0, 65)
    widths = robot.pad_distances(values)
    return float(np.interp(-width_m, -widths, values)) if len(widths) else fallback


def stalling_gripper(scene: Scene, joints: Array, theta: float, fallback: float) -> float:
    """Compute the gripper value 0..1 at which the mean distance of the two fingers' pads to the handle is 0.

    Args:
        scene: Scene with the object at its pose.
        joints: Arm joints (J,) with the gripper at the handle.
        theta: Value of the object's joint, [rad] or [m].
        fallback: Result for a robot without pads.
    """
    if not scene.robot.pads:
        return fallback
    data = mujoco.MjData(scene.model)
    opened, closed = 0.0, 1.0
    for _ in range(STALL_STEPS):
        middle = 0.5 * (opened + closed)
        gaps = _finger_gaps_m(scene, data, scene.qpos(joints[None], middle, theta)[0])
        opened, closed = (middle, closed) if sum(gaps) > 0 else (opened, middle)
    return opened


def place_scene(scene: Scene, data: mujoco.MjData, qpos: Array) -> None:
    """Set the state qpos (nq,) in `data`, and compute kinematics and contacts."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_comPos(scene.model, data)
    mujoco.mj_collision(scene.model, data)


def _finger_gaps_m(scene: Scene, data: mujoco.MjData, qpos: Array) -> list[float]:
    """Compute the distance between the handle and each finger's pads, negative for overlaps, [m]; 0 without pads."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    held = np.flatnonzero(_held(scene))
    gaps = []
    for finger in (0, 1):
        pads = np.flatnonzero(scene.roles.finger == finger)
        distances = [
            mujoco.mj_geomDistance(scene.model, data, int(pad), int(part), 0.2, None)
            for pad, part in product(pads, held)
        ]
        gaps.append(min(distances, default=0.0))
    return gaps
