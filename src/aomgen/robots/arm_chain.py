"""Which joints of a robot are its arm, which belong to its hand."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from aomgen.errors import MalformedFileError


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmChain:
    """The arm in a model.

    Attributes:
        joints: Names in the order of the joint log.
        last_body: Id of the body that the last arm joint moves; the hand hangs on it.
        hand_bodies: Ids of the bodies from there on, the last body's own rigid attachments included.
        hand_joints: Names of the joints below the last arm joint.
    """

    joints: tuple[str, ...]
    last_body: int
    hand_bodies: tuple[int, ...]
    hand_joints: tuple[str, ...]


def arm_chain(model: mujoco.MjModel, wanted: Sequence[str], path: Path) -> ArmChain:
    """Find the arm by the names of its joints, or by the shape of the tree.

    Args:
        model: Of the robot alone; hinge and slide joints.
        wanted: Names in the joint log's order; empty takes the joints from the base on until the
            bodies branch into fingers.
        path: The robot's file, for messages.

    Raises:
        MalformedFileError: A name is unknown, the joints lie on more than one branch, or a joint
            between them is not listed.
    """
    known = [model.joint(j).name for j in range(model.njnt)]
    names = tuple(wanted) or _unbranched(model)
    absent = [name for name in names if name not in known]
    if absent:
        raise MalformedFileError(
            path, f"has no joint '{absent[0]}'", f"name its own in robot.joints: {', '.join(known)}"
        )
    bodies = [int(model.jnt_bodyid[known.index(name)]) for name in names]
    last = max(bodies, key=lambda body: len(_ancestors(model, body)))
    line = {last, *_ancestors(model, last)}
    aside = [name for name, body in zip(names, bodies, strict=True) if body not in line]
    if aside:
        raise MalformedFileError(
            path,
            f"has joint '{aside[0]}' on another branch than the other arm joints",
            "list one arm's joints",
        )
    below = {body for body in range(1, model.nbody) if last in (body, *_ancestors(model, body))}
    hand = tuple(
        known[j] for j in range(model.njnt) if model.jnt_bodyid[j] in below and known[j] not in names
    )
    left = [name for name in known if name not in names and name not in hand]
    if left:
        raise MalformedFileError(
            path,
            f"has joint '{left[0]}', which is neither listed in robot.joints nor part of the hand",
            "log it too, or fix it in the file",
        )
    return ArmChain(joints=names, last_body=last, hand_bodies=tuple(sorted(below)), hand_joints=hand)


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies between a body and the world, nearest first."""
    result = []
    while body := int(model.body_parentid[body]):
        result.append(body)
    return result


def _unbranched(model: mujoco.MjModel) -> tuple[str, ...]:
    """Joints from the base on while only one of a body's branches moves; of a fork none."""
    moving = {int(body) for body in model.jnt_bodyid}
    moving |= {body for j in model.jnt_bodyid for body in _ancestors(model, int(j))}
    names: list[str] = []
    body = 0
    while True:
        branches = [int(b) for b in np.flatnonzero(model.body_parentid == body) if b and int(b) in moving]
        if len(branches) != 1:
            return tuple(names)
        body = branches[0]
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        names += [model.joint(j).name for j in range(first, first + count)]
