"""The hand of a robot file: how it closes, with which faces it holds, where its end effector is."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.core.robot_choice import HandChoice
from aomgen.core.transforms import apply, invert, quat_from_matrix, transform
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.robots.arm_chain import ArmChain
from aomgen.robots.contact_faces import (
    FingerFace,
    SurfaceSamples,
    Travel,
    find_contact_row,
    find_finger_travel,
    holding_face,
    poses_at,
    surfaces,
)
from aomgen.robots.finger_coupling import REMEDY, STEPS, drivers_of, finger_positions
from aomgen.robots.gripper import GripperTable

SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileHand:
    """What was found.

    Attributes:
        table: Finger joints over the gripper value.
        driven: For each driver its values at gripper 0 and 1 (2,), [rad] or [m].
        faces: Left and right.
        way_m: How much nearer the fingers come from open to closed.
        T_hand_ee: Pose (4, 4) of the grasp point on the last arm body: z out of the palm, y from the
            left to the right finger.
    """

    table: GripperTable
    driven: Mapping[str, tuple[float, float]]
    faces: tuple[FingerFace, FingerFace]
    way_m: float
    T_hand_ee: Array


def find_hand(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    chain: ArmChain,
    actuated: tuple[str, ...],
    shown: NDArray[np.bool_],
    choice: HandChoice,
    path: Path,
) -> FileHand:
    """Find out how a hand closes.

    The drivers go from one end of their ranges to the other; closed is where the fingers are nearer.

    Args:
        spec, model: The robot.
        chain: Its arm and hand.
        actuated: Joints that the file's actuators drove.
        shown: (G,) geoms that are seen.
        choice: What the capture tells.
        path: For messages.

    Raises:
        MalformedFileError: The file does not tell, or has no two fingers that close on each other.
    """
    skins = surfaces(model, chain.hand_bodies, shown)
    way = _way(spec, model, chain, actuated, skins, choice, path)
    pair = _named_pair(model, choice, path) if choice.fingers else way.travel.bodies
    Ts = poses_at(model, _states(model, chain, way.positions))
    row = find_contact_row(skins, Ts, pair)
    left, right = _sides(model, pair) if not choice.fingers else pair
    faces = [holding_face(skins, Ts, row, a, b) for a, b in ((left, right), (right, left))]
    if faces[0] is None or faces[1] is None:
        names = " and ".join(model.body(body).name for body in pair)
        raise MalformedFileError(
            path, f"fingers {names} have no faces that meet", "name others as robot.hand.fingers"
        )
    return FileHand(
        table=GripperTable(joint_names=chain.hand_joints, values=_even(0.0, 1.0), positions=way.positions),
        driven={name: (float(values[0]), float(values[-1])) for name, values in way.driven.items()},
        faces=(faces[0], faces[1]),
        way_m=way.travel.way_m,
        T_hand_ee=_grasp_frame(Ts[row], chain.last_body, (faces[0], faces[1])),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """One way to close: the drivers' values (K,), all hand joints (K, F), and what the fingers do."""

    driven: Mapping[str, Array]
    positions: Array
    travel: Travel

    def reversed(self) -> "_Way":
        back = Travel(bodies=self.travel.bodies, way_m=-self.travel.way_m, gap_m=self.travel.gap_m)
        driven = {name: values[::-1] for name, values in self.driven.items()}
        return _Way(driven=driven, positions=self.positions[::-1], travel=back)


def _way(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    chain: ArmChain,
    actuated: tuple[str, ...],
    skins: dict[int, SurfaceSamples],
    choice: HandChoice,
    path: Path,
) -> _Way:
    """The way from open to closed on which the fingers come nearer by most."""
    names = drivers_of(model, chain, actuated, tuple(choice.open), path)
    if set(choice.open) != set(choice.closed):
        raise MalformedFileError(
            path, "robot.hand.open and .closed name different joints", "give both values for each joint"
        )
    if choice.open:
        candidates = [{name: _even(choice.open[name], choice.closed[name]) for name in names}]
    else:
        candidates = _both_ways([(name, *_range(model, name, path)) for name in names])
    found: list[_Way] = []
    for driven in candidates:
        positions = finger_positions(spec, model, chain, driven, path)
        states = _states(model, chain, positions)
        travel = find_finger_travel(model, chain, skins, states[0], states[-1])
        if travel is not None:
            way = _Way(driven=driven, positions=positions, travel=travel)
            found.append(way.reversed() if travel.way_m < 0 and not choice.open else way)
    if not found:
        raise MalformedFileError(path, "has no two fingers that close on each other", REMEDY)
    best = max(found, key=lambda way: way.travel.way_m)
    if not best.travel.way_m > 0:
        raise MalformedFileError(
            path, "fingers are farther apart when closed (robot.hand)", "exchange open and closed"
        )
    return best


def _both_ways(ranges: list[tuple[str, float, float]]) -> list[dict[str, Array]]:
    """Joints from their lower to their upper ends; of two, also one against the other."""
    up = {name: _even(low, high) for name, low, high in ranges}
    if len(ranges) < 2:
        return [up]
    last = ranges[-1][0]
    return [up, {**up, last: up[last][::-1]}]


def _even(first: float, last: float) -> Array:
    return np.asarray(np.linspace(first, last, STEPS), np.float64)


def _range(model: mujoco.MjModel, name: str, path: Path) -> tuple[float, float]:
    joint = model.joint(name)
    low, high = joint.range
    if not (joint.limited[0] and high > low):
        raise MalformedFileError(path, f"finger joint '{name}' has no limits", REMEDY)
    return float(low), float(high)


def _states(model: mujoco.MjModel, chain: ArmChain, positions: Array) -> Array:
    states = np.repeat(model.qpos0[None], len(positions), 0)
    states[:, [model.joint(name).qposadr[0] for name in chain.hand_joints]] = positions
    return states


def _named_pair(model: mujoco.MjModel, choice: HandChoice, path: Path) -> tuple[int, int]:
    known = [model.body(b).name for b in range(1, model.nbody)]
    for name in choice.fingers:
        if name not in known:
            raise MalformedFileError(
                path, f"has no body '{name}' (robot.hand.fingers)", f"bodies: {', '.join(known)}"
            )
    left, right = (int(model.body_weldid[model.body(name).id]) for name in choice.fingers)
    return left, right


def _sides(model: mujoco.MjModel, pair: tuple[int, int]) -> tuple[int, int]:
    """Left and right finger: as their names have it, else in the order of the file."""
    names = [model.body(body).name.lower() for body in pair]
    swapped = SIDES[1] in names[0] or SIDES[0] in names[1]
    return (pair[1], pair[0]) if swapped else pair


def _grasp_frame(Ts: Array, hand: int, faces: tuple[FingerFace, FingerFace]) -> Array:
    """The grasp point in the frame of the hand's body: between the faces where they meet."""
    centres = []
    for face in faces:
        top = apply(face.T_body_pad, np.array([0.0, 0.0, face.half_extents[2]]))
        centres.append(apply(invert(Ts[hand]) @ Ts[face.body], top))
    normals = [invert(Ts[hand])[:3, :3] @ Ts[face.body][:3, :3] @ face.T_body_pad[:3, 2] for face in faces]
    closing = normals[0] - normals[1]
    closing /= np.linalg.norm(closing)
    middle = np.mean(centres, axis=0)
    approach = middle - (middle @ closing) * closing
    approach /= np.linalg.norm(approach)
    return transform(np.stack([np.cross(closing, approach), closing, approach], 1), middle)


def add_hand_parts(spec: mujoco.MjSpec, model: mujoco.MjModel, hand: FileHand) -> dict[str, str]:
    """Put pad boxes on the fingers and let several drivers move as one; pad names by side."""
    names = {}
    for side, face in zip(SIDES, hand.faces, strict=True):
        body = spec.body(model.body(face.body).name)
        names[side] = f"pad_{side}"
        geom = body.add_geom(
            name=names[side],
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=face.T_body_pad[:3, 3],
            quat=quat_from_matrix(face.T_body_pad[:3, :3]),
            size=face.half_extents,
            mass=0.0,
        )
        # Rubber: it holds by friction, and gives way a little.
        geom.friction, geom.condim, geom.priority = [0.8, 0.01, 0.0005], 4, 1
        geom.solref, geom.solimp = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
    (first, (start, end)), *others = hand.driven.items()
    for name, (other_start, other_end) in others:
        ratio = (other_end - other_start) / (end - start)
        zero, other_zero = (float(model.qpos0[model.joint(n).qposadr[0]]) for n in (first, name))
        offset = other_start - other_zero - ratio * (start - zero)
        spec.add_equality(
            name=f"follow_{name}",
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1=name,
            name2=first,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            data=np.array([offset, ratio, *np.zeros(10)]),
        )
    return names
