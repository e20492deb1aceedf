"""The paper's AOMotion from end to end, with an answer that is scored like ours."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from aomgen.core.joint import Joint, JointType
from aomgen.core.motion import ContactPatch, MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.errors import InputError
from aomgen.motion.inputs import MotionInput, read_gripper_signals
from aomgen.motion.motion_test import MIN_ODDS
from aomgen.motion.part_shape import infer_direction
from aomgen.paper.contact_points import NearestPair, contact_path, nearest_pair
from aomgen.paper.edge_joint import PairWeights, box_joint
from aomgen.paper.joint_values import recovered_thetas
from aomgen.paper.mask_keyframes import PartMasks, Scores, Variant, flagged_frames, scored_frames


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperMotionParams:
    """What the paper takes as given, and which of its formulas are repaired.

    Attributes:
        joint_type: Known beforehand; the paper does not find it.
        threshold: Noise in the keyframes' threshold, see `keyframes.score_threshold`.
        signs: Signs of the edge cost, see `joint.pair_costs`; repaired also means that `v_ee` of a
            prismatic joint is the hand's displacement, where printed takes its approach.
        weights: Of the edge cost.
    """

    joint_type: JointType
    threshold: Variant = "printed"
    signs: Variant = "printed"
    weights: PairWeights = field(default_factory=PairWeights)


def _unheard(curve: MotionCurve) -> None:
    """Nobody listens."""


def estimate_motion_paper(
    demonstration: MotionInput,
    masks: PartMasks,
    params: PaperMotionParams,
    progress: Progress = silent,
    on_curve: Callable[[MotionCurve], None] = _unheard,
) -> MotionEstimate:
    """Recover the part's motion as the paper does.

    What the paper does not know is filled in as follows: standard deviations, intervals, slip, pivot,
    type margin and turn ratio are 0; the odds of the prompted part are those that
    nobody doubts; the axis points so that the motion ends at a positive value.

    Args:
        demonstration: As our own estimator gets it.
        masks: Moving part and robot in every frame of its video, at any size.
        params: Joint type and variants.
        progress: Told about each submodule.
        on_curve: Hears the motion score before it is refused.

    Raises:
        InputError: Masks of another number of frames; a part with hardly any points.
        NoMotionError: The threshold never fires.

    Source: AOMGen, sec. 4.2, AOMotion. Not checked: prompts, contact, and whether the motion is long
    enough; the paper always answers.
    """
    demo, frames = demonstration, demonstration.video.times_s
    if not len(masks.moving) == len(frames):
        raise InputError(
            "masks of the demonstration",
            f"{len(masks.moving)} frames, the video has {len(frames)}",
            "give one mask a frame",
        )
    progress(0.0, "keyframes")
    scored = scored_frames(masks, params.threshold)
    curve = _curve(demo, scored)
    on_curve(curve)
    interval = flagged_frames(scored)
    held = frames[interval[0] : interval[1] + 1]
    progress(0.3, "contact")
    pair = nearest_pair(demo.robot, demo.log, demo.points_moving, float(held[0]), np.random.default_rng(0))
    path = contact_path(pair, demo.robot, demo.log, held)
    T_world_ee = demo.robot.ee_poses(demo.log.at(held[:1])[0])[0]
    progress(0.6, "joint")
    direction = T_world_ee[:3, :3] @ demo.robot.approach_ee
    if params.joint_type == "prismatic" and params.signs == "repaired":
        step = path[-1] - path[0]
        direction = step / max(float(np.linalg.norm(step)), 1e-9)
    points = (demo.points_static, demo.points_moving)
    found = box_joint(points, pair.on_part, direction, params.joint_type, params.signs, params.weights)
    joint = Joint(type=params.joint_type, axis=found.axis, origin=found.origin, lower=0.0, upper=0.0)
    progress(0.9, "joint values")
    thetas = recovered_thetas(joint, pair.on_part, found.face_normal, path)
    sense = -1.0 if thetas[-1] < 0 else 1.0
    joint = Joint(
        type=joint.type,
        axis=sense * joint.axis,
        origin=joint.origin,
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


def _curve(demo: MotionInput, scored: Scores) -> MotionCurve:
    signals = read_gripper_signals(demo, demo.video.times_s)
    return MotionCurve(
        times_s=demo.video.times_s,
        scores=scored.scores,
        smoothed=scored.smoothed,
        threshold=scored.threshold,
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
