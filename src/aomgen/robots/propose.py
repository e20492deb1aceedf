"""Proposal of a robot.toml, estimated from the joints and shapes of any URDF or MJCF.

The user checks the proposal. Other modules of AOMGen do not estimate the roles of a robot's parts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from aomgen.core.transforms import apply, invert, quat_from_matrix, transform
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.io.mujoco_model import compile_model, read_robot_xml
from aomgen.robots.description import (
    EndEffectorSection,
    GripperSection,
    PadSection,
    RobotDescription,
    RobotFiles,
)
from aomgen.robots.gripper import settle_fingers
from aomgen.robots.gripper_surface import (
    Skins,
    find_contact_row,
    find_face,
    find_fingers,
    sample_hand,
)
from aomgen.robots.reading import ArmChain, ancestors, arm_chain, read_robot_spec
from aomgen.robots.robot import RobotModel, body_poses

# Common names of the end effector site in models of arms without gripper, in order of preference.
EE_SITES = ("pinch", "ee", "attachment_site")
HELP = "see `aomgen robot propose --help`"
REMEDY = f"give the joint values of the open and closed gripper with --open and --closed: {HELP}"
# Decimal digits of the numbers in a proposal: 10 micrometers, far below the accuracy of pads, and about 1e-5 rad.
DIGITS = 5


def propose_description(
    file: Path,
    root: Path,
    joints: Sequence[str] = (),
    *,
    opened: Mapping[str, float] | None = None,
    closed: Mapping[str, float] | None = None,
    fingers: Sequence[str] = (),
) -> RobotDescription:
    """Estimate the roles of the parts of a robot.

    By default, the arm consists of the joints before the kinematic tree branches. The driving joints of the gripper are
    moved through their ranges. The gripper is closed at the end at which two of its bodies are closer to each other; their
    surfaces that meet are the pads. The end effector is between the pads.

    Args:
        file: URDF or MJCF.
        root: Folder that the references of the file must not leave.
        joints: Arm joints in the order of the joint log; empty estimates them.
        opened, closed: Value of each driving finger joint at gripper 0 and 1, [rad] or [m]; None estimates them.
        fingers: Names of the left and the right finger body; empty estimates them.

    Raises:
        InputError: The file cannot be used, or its content does not determine the roles.
    """
    xml = read_robot_xml(file, root)
    spec, actuated = read_robot_spec(RobotFiles(arm=xml), turned=False)
    model = compile_model(spec, file)
    names = tuple(joints) or _list_unbranched_joints(model)
    if not names:
        raise MalformedFileError(
            file, "branches before its first joint", f"name the arm's joints with --joint: {HELP}"
        )
    chain = arm_chain(model, names, file)
    sites = [site.name for site in spec.sites]
    gripper = None
    known = [name for name in EE_SITES if name in sites]
    end = EndEffectorSection(body="" if known else model.body(chain.last_body).name, site=(*known, "")[0])
    if chain.hand_joints:
        gripper, T_body_ee = _guess_gripper(
            _Hand(spec=spec, model=model, chain=chain, file=file),
            actuated,
            _read_stated_strokes(opened or {}, closed or {}, chain, file),
            fingers,
        )
        end = EndEffectorSection(
            body=model.body(chain.last_body).name,
            position=_round(T_body_ee[:3, 3]),
            quat_wxyz=_round(quat_from_matrix(T_body_ee[:3, :3])),
        )
    elif opened or closed or fingers:
        raise MalformedFileError(file, "has no finger joints, but values of some are given", "check the file")
    return RobotDescription(
        name=xml.name, model=file.name, joints=chain.joints, end_effector=end, gripper=gripper
    )


def _list_unbranched_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """List the joints from the base up to the first body with several moving branches."""
    moving = {int(body) for body in model.jnt_bodyid}
    moving |= {body for j in model.jnt_bodyid for body in ancestors(model, int(j))}
    names: list[str] = []
    body = 0
    while True:
        branches = [int(b) for b in np.flatnonzero(model.body_parentid == body) if b and int(b) in moving]
        if len(branches) != 1:
            return tuple(names)
        body = branches[0]
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        names += [model.joint(j).name for j in range(first, first + count)]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hand:
    """A robot whose gripper is analyzed."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    chain: ArmChain
    file: Path


def _read_stated_strokes(
    opened: Mapping[str, float], closed: Mapping[str, float], chain: ArmChain, file: Path
) -> dict[str, tuple[float, float]]:
    if set(opened) != set(closed):
        raise MalformedFileError(
            file, "open and closed values name different joints", "give --open and --closed for each joint"
        )
    known = chain.hand_joints
    for name in opened:
        if name not in known:
            raise MalformedFileError(
                file, f"has no finger joint '{name}'", f"finger joints: {', '.join(known)}"
            )
    return {name: (opened[name], closed[name]) for name in opened}


def _guess_gripper(
    hand: _Hand, actuated: Sequence[str], strokes: Mapping[str, tuple[float, float]], fingers: Sequence[str]
) -> tuple[GripperSection, Array]:
    """Estimate the gripper, and the pose (4, 4) of the end effector between its pads, in the frame of the last arm body.

    Actuators drive the joints `actuated`. The driving joints with their values when open and closed (`strokes`), and the names
    of the left and right body (`fingers`), are estimated if they are empty.
    """
    model, file = hand.model, hand.file
    skins = sample_hand(model, hand.chain)
    strokes, Ts, pair = _find_closing(hand, skins, actuated, strokes)
    pair = _find_named_pair(model, fingers, file) if fingers else _sides(model, pair)
    row = find_contact_row(skins, Ts, pair)
    faces = [find_face(skins, Ts, row, a, b) for a, b in (pair, pair[::-1])]
    if faces[0] is None or faces[1] is None:
        names = " and ".join(model.body(body).name for body in pair)
        raise MalformedFileError(
            file, f"fingers {names} have no faces that meet", f"name others with --finger: {HELP}"
        )
    pads, Ts_pad = [], []
    for body, (T, half) in zip(pair, (faces[0], faces[1]), strict=True):
        pad = PadSection(
            body=model.body(body).name,
            center=_round(T[:3, 3]),
            quat_wxyz=_round(quat_from_matrix(T[:3, :3])),
            half_extents=_round(half),
        )
        pads.append(pad)
        T_last_body = invert(Ts[row, hand.chain.last_body]) @ Ts[row, body]
        Ts_pad.append(T_last_body @ T @ transform(np.eye(3), [0.0, 0.0, half[2]]))
    section = GripperSection(
        open={name: start for name, (start, _) in strokes.items()},
        closed={name: end for name, (_, end) in strokes.items()},
        left=pads[0],
        right=pads[1],
    )
    return section, _between(*Ts_pad)


def _between(T_left: Array, T_right: Array) -> Array:
    """Compute the pose (4, 4) between two faces: z out of the palm, y from the left to the right face."""
    closing = T_left[:3, 2] - T_right[:3, 2]
    closing /= np.linalg.norm(closing)
    middle = (T_left[:3, 3] + T_right[:3, 3]) / 2
    approach = middle - (middle @ closing) * closing
    approach /= np.linalg.norm(approach)
    return transform(np.stack([np.cross(closing, approach), closing, approach], 1), middle)


def _find_closing(
    hand: _Hand,
    skins: Skins,
    actuated: Sequence[str],
    stated: Mapping[str, tuple[float, float]],
) -> tuple[Mapping[str, tuple[float, float]], Array, tuple[int, int]]:
    """Find the motion from open to closed in which the fingers approach each other most.

    Returns:
        Values of each driving joint when open and closed, [rad] or [m]; poses (K, B, 4, 4) of all bodies from open to closed,
        world frame; and the ids of the two finger bodies.
    """
    candidates = [stated]
    if not stated:
        up = {name: _range(hand, name) for name in _drivers(hand, actuated)}
        candidates = [up]
        if len(up) == 2:
            (first, ends), (last, (low, high)) = up.items()
            candidates.append({first: ends, last: (high, low)})
    best, largest_m = None, -np.inf
    for strokes in candidates:
        table = settle_fingers(hand.spec, hand.chain, strokes, hand.file)
        states = np.repeat(hand.model.qpos0[None], len(table.values), 0)
        states[:, [hand.model.joint(name).qposadr[0] for name in table.joint_names]] = table.positions
        Ts = body_poses(hand.model, states)
        pair = find_fingers(hand.model, hand.chain, skins, Ts)
        if pair is None:
            continue
        fingers, approach_m = pair
        if approach_m < 0 and not stated:
            strokes = {name: (end, start) for name, (start, end) in strokes.items()}
            Ts, approach_m = Ts[::-1], -approach_m
        if approach_m > largest_m:
            best, largest_m = (strokes, Ts, fingers), approach_m
    if best is None:
        raise MalformedFileError(hand.file, "has no two fingers that close on each other", REMEDY)
    if not largest_m > 0:
        raise MalformedFileError(
            hand.file, "fingers are farther apart when closed", "exchange --open and --closed"
        )
    return best


def _drivers(hand: _Hand, actuated: Sequence[str]) -> list[str]:
    """List the finger joints that do not follow another joint; in grippers with closed loops, only actuated ones."""
    model = hand.model
    follows = {}
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        source = int(model.eq_obj2id[equality])
        follows[model.joint(model.eq_obj1id[equality]).name] = model.joint(source).name if source >= 0 else ""
    free = [name for name in hand.chain.hand_joints if name not in follows]
    loops = np.isin(model.eq_type, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)).any()
    if loops:
        sources = {_source(name, follows) for name in actuated}
        free = [name for name in free if name in sources]
    if not free or len(free) > (1 if loops else 2):
        unknown = (
            f"how the finger joints {', '.join(free)} move together" if free else "what drives its fingers"
        )
        raise MalformedFileError(hand.file, f"does not state {unknown}", REMEDY)
    return free


def _source(name: str, follows: Mapping[str, str]) -> str:
    for _ in follows:
        name = follows.get(name, name)
    return name


def _range(hand: _Hand, name: str) -> tuple[float, float]:
    joint = hand.model.joint(name)
    low, high = joint.range
    if not (joint.limited[0] and high > low):
        raise MalformedFileError(hand.file, f"finger joint '{name}' has no limits", REMEDY)
    return float(low), float(high)


def _find_named_pair(model: mujoco.MjModel, fingers: Sequence[str], file: Path) -> tuple[int, int]:
    known = [model.body(b).name for b in range(1, model.nbody)]
    for name in fingers:
        if name not in known:
            raise MalformedFileError(file, f"has no body '{name}'", f"bodies: {', '.join(known)}")
    left, right = (int(model.body_weldid[model.body(name).id]) for name in fingers)
    return left, right


def _sides(model: mujoco.MjModel, pair: tuple[int, int]) -> tuple[int, int]:
    """Order two fingers as left and right, by their names if these contain "left" or "right", else as in the file."""
    names = [model.body(body).name.lower() for body in pair]
    return (pair[1], pair[0]) if "right" in names[0] or "left" in names[1] else pair


def _round(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in np.round(values, DIGITS) + 0.0)


def describe_sizes(robot: RobotModel) -> str:
    """Describe the arm, gripper and end effector of a robot in a text that lets the user check them."""
    arm = f"arm            {len(robot.joint_names)} joints: {', '.join(robot.joint_names)}"
    if not robot.pads:
        return f"{arm}\ngripper        none: such a robot can be followed, but not verified"
    middle = np.clip(robot.joint_limits, -np.pi, np.pi).mean(1)[None]
    faces = np.array(
        [
            [apply(Ts[pad.body], pad.face_body) for pad in robot.pads]
            for Ts in robot.link_poses(np.repeat(middle, 2, 0), np.array([0.0, 1.0]))
        ]
    )
    opened, closed = 1000 * np.linalg.norm(faces[:, 0] - faces[:, 1], axis=1)
    away = 1000 * np.linalg.norm(faces[1].mean(0) - robot.ee_poses(middle)[0, :3, 3])
    sizes = " and ".join("{:.0f} x {:.0f} mm".format(*2000 * pad.half_extents[:2]) for pad in robot.pads)
    return (
        f"{arm}\ngripper        pads {opened:.0f} mm apart when open, {closed:.0f} mm when closed; {sizes}\n"
        f"end effector   {away:.0f} mm from the point between the closed pads"
    )
