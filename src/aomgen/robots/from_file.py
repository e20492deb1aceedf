"""A robot from a user's URDF or MJCF, made ready for kinematics, images and physics."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import COLLIDER_GROUP, VISUAL_GROUP
from aomgen.core.robot_choice import HandChoice
from aomgen.core.transforms import quat_from_matrix
from aomgen.errors import MalformedFileError
from aomgen.io.robot_xml import read_robot_xml
from aomgen.robots.arm_chain import ArmChain, arm_chain
from aomgen.robots.gripper_from_file import FileHand, add_hand_parts, find_hand
from aomgen.robots.robot_files import EE_SITES, drop_visual
from aomgen.robots.robot_reading import compile_model, read_robot_spec
from aomgen.robots.servos import add_arm_servos, add_grip_servo, structural_overlaps

GRASP_SITE = "grasp_point"
# MuJoCo shows these groups by default; makers put collision shapes into the others.
SHOWN_GROUPS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class FileRobot:
    """A file's robot.

    Attributes:
        name: As the file has it.
        full, bare: With and without what is only seen; copied before every use.
        chain: Arm and hand.
        hand: None for an arm without fingers.
        pad_geoms: Names of each finger's colliding shapes.
        actuator: Closes the hand; empty without one.
        ee_site: End effector.
        hand_bodies: Names of the bodies that hang on the last arm body.
    """

    name: str
    full: mujoco.MjSpec
    bare: mujoco.MjSpec
    chain: ArmChain
    hand: FileHand | None
    pad_geoms: dict[str, tuple[str, ...]]
    actuator: str
    ee_site: str
    hand_bodies: tuple[str, ...]


def read_file_robot(
    path: Path, root: Path, joints: Sequence[str], choice: HandChoice, *, turned: bool
) -> FileRobot:
    """Read a robot file and find out what its parts are for.

    Args:
        path: URDF or MJCF.
        root: Folder that all its references stay in.
        joints: Arm joints in the order of the log; empty takes those before the fingers branch.
        choice: What the capture states about the gripper.
        turned: World is turned by 180 degrees about z against the file's root frame.

    Raises:
        InputError: Of the kind that fits; see `read_robot_xml`, `arm_chain` and `find_hand`.
    """
    xml = read_robot_xml(path, root)
    spec, actuated = read_robot_spec(xml, turned)
    model = compile_model(spec, xml)
    chain = arm_chain(model, joints, path)
    shown = find_visible_geoms(model)
    hand = None
    if chain.hand_joints:
        hand = find_hand(spec, model, chain, actuated, shown, choice, path)
    elif choice.open or choice.fingers:
        raise MalformedFileError(path, "has no finger joints, but robot.hand names some", "check the file")
    ee_site = _end_effector(spec, model, chain, hand, choice, path)
    _sort_geoms(spec, model, shown)
    _fix_inertias(spec, model)
    pads: dict[str, tuple[str, ...]] = {}
    if hand is not None:
        boxes = add_hand_parts(spec, model, hand)
        pads = {
            side: (boxes[side], *_colliders(model, face.body))
            for side, face in zip(boxes, hand.faces, strict=True)
        }
    bare = spec.copy()
    drop_visual(bare)
    # Compiles ten times faster than with visual meshes, and weighs the same.
    light = compile_model(bare, xml)
    add_arm_servos((spec, bare), light, chain.joints, ee_site)
    actuator = ""
    if hand is not None:
        (driver, (start, end)), *_ = hand.driven.items()
        actuator = add_grip_servo((spec, bare), driver, end - start, hand.way_m)
    names = tuple(model.body(b).name for b in chain.hand_bodies)
    for a, b in _overlapping(light, chain, names):
        for item in (spec, bare):
            item.add_exclude(name=f"apart_{a}_{b}", bodyname1=a, bodyname2=b)
    return FileRobot(
        name=xml.name,
        full=spec,
        bare=bare,
        chain=chain,
        hand=hand,
        pad_geoms=pads,
        actuator=actuator,
        ee_site=ee_site,
        hand_bodies=names[1:],
    )


def find_visible_geoms(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Which geoms (G,) are seen: those without contacts in a shown group; for a body without any,
    its colliding ones in a shown group, unless collision shapes have a group of their own.
    """
    ours = (model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0)
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    shown = ours & (model.geom_group < SHOWN_GROUPS)
    visual = shown & ~colliding
    # One group for all that collides and another for all that is seen: then nothing else is meant.
    apart = visual.any() and not set(model.geom_group[visual]) & set(model.geom_group[ours & colliding])
    if apart:
        return visual
    bare = ~np.isin(model.geom_bodyid, model.geom_bodyid[visual])
    return visual | (shown & colliding & bare)


def _end_effector(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    chain: ArmChain,
    hand: FileHand | None,
    choice: HandChoice,
    path: Path,
) -> str:
    sites = [site.name for site in spec.sites]
    if choice.ee_site:
        if choice.ee_site not in sites:
            raise MalformedFileError(
                path,
                f"has no site '{choice.ee_site}' (robot.hand.ee_site)",
                f"sites: {', '.join(sites) or 'none; leave the key out'}",
            )
        return choice.ee_site
    if hand is None:
        known = [name for name in EE_SITES if name in sites]
        if known:
            return known[0]
    name = GRASP_SITE
    while name in sites:
        name += "_"
    site = spec.body(model.body(chain.last_body).name).add_site(name=name)
    if hand is not None:
        site.pos, site.quat = hand.T_hand_ee[:3, 3], quat_from_matrix(hand.T_hand_ee[:3, :3])
    return name


def _sort_geoms(spec: mujoco.MjSpec, model: mujoco.MjModel, shown: NDArray[np.bool_]) -> None:
    """Put what is seen and what collides into the groups that ours have."""
    for number, seen in enumerate(shown):
        geom = spec.geom(model.geom(number).name)
        geom.group = VISUAL_GROUP if seen else COLLIDER_GROUP


def _fix_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Write every body's mass down, so that shapes may come and go."""
    for number in range(1, model.nbody):
        body = spec.body(model.body(number).name)
        body.explicitinertial = True
        body.mass = model.body_mass[number]
        body.ipos, body.iquat = model.body_ipos[number], model.body_iquat[number]
        body.inertia = model.body_inertia[number]
        body.fullinertia = np.full(6, np.nan)


def _colliders(model: mujoco.MjModel, root: int) -> list[str]:
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    ours = model.body_weldid[model.geom_bodyid] == root
    return [model.geom(int(geom)).name for geom in np.flatnonzero(ours & colliding)]


def _overlapping(
    model: mujoco.MjModel, chain: ArmChain, hand_bodies: tuple[str, ...]
) -> list[tuple[str, str]]:
    """Pairs inside the hand, and of shapes that always overlap: their contacts say nothing about a plan."""
    pairs = {(a, b) for i, a in enumerate(hand_bodies) for b in hand_bodies[i + 1 :]}
    pairs |= set(structural_overlaps(model, chain.joints))
    signatures = {int(signature) for signature in model.exclude_signature}

    def known(a: str, b: str) -> bool:
        first, second = sorted((model.body(a).id, model.body(b).id))
        return (first << 16) + second in signatures

    return sorted(pair for pair in pairs if not known(*pair))
