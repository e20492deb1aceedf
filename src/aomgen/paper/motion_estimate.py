"""The paper's AOMotion from end to end, with a result that is scored like ours."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.joint import Joint, JointType
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.core.recording import JointLog
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Vector3, freeze_arrays
from aomgen.errors import InputError
from aomgen.motion.estimate import OnCurve, ignore_curve
from aomgen.motion.inputs import MotionInput, read_gripper_signals
from aomgen.motion.motion_detection import MIN_ODDS
from aomgen.motion.part_shape import infer_direction
from aomgen.paper.edge_joint import box_joint
from aomgen.paper.mask_keyframes import (
    PartMasks,
    Variant,
    flag_frames,
    motion_scores,
    score_threshold,
    smooth_scores,
)
from aomgen.robots.robot import RobotModel

# As dense as the Gaussians of a scanned robot, and denser than those of the part, [m].
SPACING_M = 0.003
# A plane that slides within itself by more than this share of a motion does not determine the motion.
_MIN_ACROSS = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestPair:
    """Contact point on either side.

    Attributes:
        body: Robot body that touches, an index into `RobotModel.body_names`.
        point_body: Contact point on it (3,), body frame, [m].
        on_robot: The same at the start of the motion (3,), world frame, [m].
        on_part: Contact point on the moving part (3,), world frame, [m].
    """

    body: int
    point_body: Vector3
    on_robot: Vector3
    on_part: Vector3

    __post_init__ = freeze_arrays

    @property
    def gap_m(self) -> float:
        """Distance between the two, [m]."""
        return float(np.linalg.norm(self.on_part - self.on_robot))


def estimate_motion_paper(
    demo: MotionInput,
    masks: PartMasks,
    joint_type: JointType,
    variant: Variant = "printed",
    progress: Progress = silent,
    on_curve: OnCurve = ignore_curve,
) -> MotionEstimate:
    """Recover the part's motion as the paper does.

    What the paper does not know is filled in as follows: standard deviations, intervals, slip, pivot,
    type margin and turn ratio are 0; the likelihood ratio of the prompted part is the one of a part
    without doubt; the axis points so that the motion ends at a positive value.

    Args:
        demo: Video, log and scan.
        masks: Moving part and robot in every frame of its video, at any size.
        joint_type: Known beforehand; the paper does not find it.
        variant: Repaired formulas; `v_ee` of a prismatic joint is the end effector's displacement if "repaired",
            and its approach otherwise.
        progress: Receives the progress.
        on_curve: Receives the motion score before the demonstration is refused.

    Raises:
        InputError: Masks of another number of frames; a part with hardly any points.
        NoMotionError: The threshold never fires.

    Source: AOMGen, sec. 4.2, AOMotion. Not checked: prompts, contact, and whether the motion is long
    enough; the paper always returns an estimate.
    """
    frames = demo.video.times_s
    if not len(masks.moving) == len(frames):
        raise InputError(
            "masks of the demonstration",
            f"{len(masks.moving)} frames, the video has {len(frames)}",
            "give one mask a frame",
        )
    progress(0.0, "keyframes")
    curve = _measure_curve(demo, masks, variant)
    on_curve(curve)
    interval = flag_frames(curve.smoothed, curve.threshold)
    held = frames[interval[0] : interval[1] + 1]
    progress(0.3, "contact")
    pair = nearest_pair(demo.robot, demo.log, demo.points_moving, float(held[0]), np.random.default_rng(0))
    path = contact_path(pair, demo.robot, demo.log, held)
    T_world_ee = demo.robot.ee_poses(demo.log.at(held[:1])[0])[0]
    progress(0.6, "joint")
    direction = T_world_ee[:3, :3] @ demo.robot.approach_ee
    if joint_type == "prismatic" and variant == "repaired":
        step = path[-1] - path[0]
        direction = step / max(float(np.linalg.norm(step)), 1e-9)
    points = (demo.points_static, demo.points_moving)
    joint, face_normal = box_joint(points, pair.on_part, direction, joint_type, variant)
    progress(0.9, "joint values")
    thetas = recover_thetas(joint, pair.on_part, face_normal, path)
    sense = -1.0 if thetas[-1] < 0 else 1.0
    joint = replace(
        joint,
        axis=sense * joint.axis,
        lower=min(0.0, float((sense * thetas).min())),
        upper=max(0.0, float((sense * thetas).max())),
    )
    return _assemble(demo, curve, interval, pair, joint, sense * thetas)


def _assemble(
    demo: MotionInput,
    curve: MotionCurve,
    interval: tuple[int, int],
    pair: NearestPair,
    joint: Joint,
    thetas: Array,
) -> MotionEstimate:
    frames, (first, last) = demo.video.times_s, interval
    T_world_ee = demo.robot.ee_poses(demo.log.at([frames[first]])[0])[0]
    values = np.zeros(len(frames))
    values[first : last + 1] = thetas
    values[last + 1 :] = values[last]
    nothing = np.zeros(len(frames))
    return MotionEstimate(
        clock_offset_s=demo.clock.offset_s,
        clock_offset_sd_s=demo.clock.sd_s,
        start_s=float(frames[first]),
        end_s=float(frames[last]),
        curve=curve,
        contacts=(_patch(demo, pair),),
        grasp_ee=apply(invert(T_world_ee), pair.on_robot),
        joint=joint,
        axis_sd_rad=0.0,
        origin_sd_m=0.0,
        axis_ci95_rad=0.0,
        origin_ci95_m=0.0,
        type_margin=0.0,
        ee_turn_ratio=0.0,
        times_s=frames,
        thetas=values,
        theta_sd=nothing,
        slip_m=nothing,
        pivot_rad=nothing,
        direction=infer_direction(joint, float(values[-1]), demo.points_static, demo.points_moving),
        part_odds=MIN_ODDS,
    )


def _measure_curve(demo: MotionInput, masks: PartMasks, variant: Variant) -> MotionCurve:
    """Compute the paper's motion score; the last frame has no successor and repeats the previous value."""
    signals = read_gripper_signals(demo, demo.video.times_s)
    scores = motion_scores(masks)
    smoothed = smooth_scores(scores)
    return MotionCurve(
        times_s=demo.video.times_s,
        scores=np.append(scores, scores[-1]),
        smoothed=np.append(smoothed, smoothed[-1]),
        threshold=score_threshold(scores, smoothed, variant),
        distances_m=signals.distances_m,
        speeds_m_s=signals.speeds_m_s,
        gripper=signals.gripper,
    )


def _patch(demo: MotionInput, pair: NearestPair) -> ContactPatch:
    names = {pad.body: pad.finger for pad in demo.robot.pads}
    gap = pair.gap_m
    towards = pair.on_part - pair.on_robot
    return ContactPatch(
        finger=names.get(pair.body, "hand"),
        point=pair.on_robot,
        normal=towards / gap if gap > 1e-9 else np.array([0.0, 0.0, 1.0]),
        spread_m=0.0,
        gap_m=gap,
    )


def nearest_pair(
    robot: RobotModel, log: JointLog, points_moving: Array, start_log_s: float, rng: np.random.Generator
) -> NearestPair:
    """Find the point of the robot nearest to the part at one time, and the point of the part nearest to it.

    Args:
        robot: Kinematics and meshes, whose surfaces stand for the paper's robot Gaussians.
        points_moving: Points of the part at its scanned place (N, 3), world frame, [m].
        start_log_s: Start of the motion, log clock, [s].

    Raises:
        InputError: The robot has no meshes.

    Source: AOMGen, sec. 4.2, "Contact Point Detection". Not checked: contact; `gap_m` states the distance.
    """
    poses = robot.link_poses(*log.at([start_log_s]))[0]
    tree = cKDTree(points_moving)
    best: NearestPair | None = None
    for mesh in robot.meshes:
        _, areas = face_normals_areas(mesh.vertices_body, mesh.faces)
        count = max(1, round(float(areas.sum()) / SPACING_M**2))
        points_body, _, _ = sample_surface(mesh.vertices_body, mesh.faces, count, rng)
        points = apply(poses[mesh.body], points_body)
        gaps, partners = tree.query(points, distance_upper_bound=best.gap_m if best else np.inf)
        nearest = int(np.argmin(gaps))
        if np.isfinite(gaps[nearest]):
            best = NearestPair(
                body=mesh.body,
                point_body=points_body[nearest],
                on_robot=points[nearest],
                on_part=points_moving[partners[nearest]],
            )
    if best is None:
        raise InputError("robot model", "has no meshes", "give a model with visual meshes")
    return best


def contact_path(pair: NearestPair, robot: RobotModel, log: JointLog, log_times_s: Array) -> Array:
    """Compute the path of the robot's contact point (T, 3), world frame, [m]; this is the paper's trajectory."""
    return apply(robot.link_poses(*log.at(log_times_s))[:, pair.body], pair.point_body)


def recover_thetas(joint: Joint, plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Compute the joint value (T,) of every frame of the motion, [rad] or [m].

    Where no plane passes through the contact the one that comes nearest counts. Where the face slides
    within itself, as that of a sliding door does, every value meets the contact and 0 is kept.

    The paper looks for the theta_t that minimizes the distance between the contact point PC_r,t and the
    point in which the face's plane, moved by theta_t, meets the contact's trajectory. PC_r,t lies on that
    trajectory, so the distance is zero wherever the plane passes through PC_r,t itself, and the minimum is
    a root in closed form. A plane through a point has two such angles about an axis; the paper does not
    choose, and here it is the one next to the frame before.

    Args:
        joint: World frame.
        plane_point, plane_normal: The face's plane at theta 0, world frame, (3,) each.
        path: The contact's trajectory PC_r (T, 3), [m].

    Source: AOMGen, sec. 4.2, "Movable Part Motion Recovery".
    """
    if joint.type == "prismatic":
        across = float(plane_normal @ joint.axis)
        if not abs(across) > _MIN_ACROSS:
            return np.zeros(len(path))
        return (path - plane_point) @ plane_normal / across
    flat_normal = plane_normal - (plane_normal @ joint.axis) * joint.axis
    if not float(np.linalg.norm(flat_normal)) > _MIN_ACROSS:
        return np.zeros(len(path))
    return _angles(joint, plane_point, plane_normal, path)


def _angles(joint: Joint, plane_point: Array, plane_normal: Array, path: Array) -> Array:
    """Solve `n(theta) . (x - o) = n . (p - o)` for theta, written as `a cos + b sin = c`."""
    offsets = path - joint.origin
    along = float(plane_normal @ joint.axis)
    c = plane_normal @ (plane_point - joint.origin) - along * (offsets @ joint.axis)
    a = offsets @ plane_normal - along * (offsets @ joint.axis)
    b = offsets @ np.cross(joint.axis, plane_normal)
    middle = np.arctan2(b, a)
    spread = np.arccos(np.clip(c / np.maximum(np.hypot(a, b), 1e-12), -1.0, 1.0))
    thetas, last = np.empty(len(path)), 0.0
    for k, candidates in enumerate(zip(middle - spread, middle + spread, strict=True)):
        turns = [angle + 2 * np.pi * np.round((last - angle) / (2 * np.pi)) for angle in candidates]
        last = thetas[k] = min(turns, key=lambda angle: abs(angle - last))
    return thetas
