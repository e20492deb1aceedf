"""Conversion of a robot's files to one editable MuJoCo model that contains nothing but the robot."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from aomgen.errors import MalformedFileError
from aomgen.io.mujoco_model import LEAST_INERTIA, LEAST_MASS, RobotXml, compile_model, parse_spec
from aomgen.robots.description import RobotFiles

# Temporary prefix of the names while the content of a file is attached to a new model.
TAKEOVER = "file/"
# Time step and gravity, [m/s^2], of all robots, whatever the scene in the file states.
TIMESTEP_S, GRAVITY = 0.002, (0.0, 0.0, -9.81)
SCENE_SIZES = ("nuser_actuator", "nuser_body", "nuser_cam", "nuser_geom", "nuser_jnt", "nuser_sensor",
               "nuser_site", "nuser_tendon", "njmax", "nconmax")  # fmt: skip
BASE_BODY = "robot_base"


def set_options(spec: mujoco.MjSpec) -> None:
    """Set angles in radians, and the solver settings that all robot models have in common."""
    spec.compiler.degree = False
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo 4.0.0 factorizes sparse Newton systems incorrectly; dense ones are also faster at this size.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE


def read_finished_spec(files: RobotFiles, *, turned: bool) -> mujoco.MjSpec:
    """Read a robot whose files contain nothing else, and keep its own actuators and contact shapes.

    Args:
        files: Model files of the robot.
        turned: Rotate the world by 180 degrees about z relative to the root frame of the file.

    Raises:
        MalformedFileError: MuJoCo cannot read a file, a file states angles in degrees, or the site `files.attach` is missing.
    """
    spec = parse_spec(files.arm)
    parts = [spec] if files.gripper is None else [spec, parse_spec(files.gripper)]
    for part in parts:
        if part.compiler.degree:
            raise MalformedFileError(
                files.arm.path, "states angles in degrees", 'save it with angle="radian"'
            )
        for item in (*part.keys, *part.lights):
            part.delete(item)
        set_options(part)
    if files.gripper is not None:
        _attach(spec, parts[1], files)
    if turned:
        for body in spec.worldbody.bodies:
            body.set_frame(spec.worldbody.add_frame(quat=[0.0, 0.0, 0.0, 1.0]))
    return spec


def _attach(spec: mujoco.MjSpec, part: mujoco.MjSpec, files: RobotFiles) -> None:
    if files.attach not in [item.name for item in spec.sites]:
        raise MalformedFileError(
            files.arm.path, f"has no site '{files.attach}' (gripper.attach)", "name one that it has"
        )
    spec.attach(part, site=files.attach, prefix=files.prefix)


def read_robot_spec(files: RobotFiles, *, turned: bool) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """Read the robot of any file, in radians and with named bodies, without actuators, sensors, lights, cameras and floor.

    Only the tree of bodies with the most joints is kept; all other content of the file's scene (tables, objects, mocap
    targets) is removed. Geoms of the world body, except floors, become part of the body "robot_base".

    Args:
        files: Model files of the robot.
        turned: Rotate the world by 180 degrees about z relative to the root frame of the file.

    Returns:
        Description of the robot, and the names of the joints that the file's actuators drive.

    Raises:
        MalformedFileError: MuJoCo cannot read a file, no body has hinge or slide joints, or the site `files.attach` is
            missing.
    """
    arm, source = files.arm, parse_spec(files.arm)
    if files.gripper is not None:
        _attach(source, parse_spec(files.gripper), files)
    actuated = _find_actuated_joints(source, arm)
    for kind in ("keys", "lights", "cameras", "sensors", "actuators", "tendons", "pairs"):
        for item in list(getattr(source, kind)):
            source.delete(item)
    for equality in list(source.equalities):
        if equality.type in (mujoco.mjtEq.mjEQ_TENDON, mujoco.mjtEq.mjEQ_FLEX):
            source.delete(equality)
    _keep_robot_tree(source, arm)
    spec = mujoco.MjSpec()
    for compiler in (spec.compiler, source.compiler):
        compiler.boundmass, compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
        compiler.balanceinertia = True
    # The solver settings of the scene in the file do not belong to the robot, and MuJoCo would warn about each difference.
    for name in SCENE_SIZES:
        setattr(source, name, getattr(spec, name))
    for name in dir(spec.option):
        if not name.startswith("_"):
            setattr(source.option, name, getattr(spec.option, name))
    spec.compiler.degree = False
    spec.compiler.conflict = mujoco.mjtConflict.mjCONFLICT_MERGE
    home = spec.worldbody
    if source.worldbody.geoms or source.worldbody.sites:
        home = home.add_body(name=BASE_BODY)
    turn = [0.0, 0.0, 0.0, 1.0] if turned else [1.0, 0.0, 0.0, 0.0]
    spec.attach(source, prefix=TAKEOVER, frame=home.add_frame(quat=turn))
    _rename(spec)
    set_options(spec)
    spec.option.timestep, spec.option.gravity = TIMESTEP_S, GRAVITY
    return spec, actuated


def _find_actuated_joints(spec: mujoco.MjSpec, xml: RobotXml) -> tuple[str, ...]:
    by_kind = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON
    names, pulled = ([item.target for item in spec.actuators if item.trntype == kind] for kind in by_kind)
    if pulled:
        model = compile_model(spec.copy(), xml.path)
        for tendon in pulled:
            number = model.tendon(tendon).id
            start, count = model.tendon_adr[number], model.tendon_num[number]
            wraps = range(start, start + count)
            joints = [w for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
            names += [model.joint(model.wrap_objid[w]).name for w in joints]
    return tuple(dict.fromkeys(names))


def _keep_robot_tree(spec: mujoco.MjSpec, xml: RobotXml) -> None:
    moving = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)

    def joints(root: mujoco.MjsBody) -> int:
        found = root.find_all("joint")
        return len(found) if all(joint.type in moving for joint in found) else 0

    roots = list(spec.worldbody.bodies)
    counts = [joints(root) for root in roots]
    if not max(counts, default=0) > 0:
        raise MalformedFileError(
            xml.path, "holds no robot (no body with hinge or slide joints)", "give the file of the arm"
        )
    robot = int(np.argmax(counts))
    for number, root in enumerate(roots):
        if number != robot:
            _delete_references(spec, root)
            spec.delete(root)
    for geom in list(spec.worldbody.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            spec.delete(geom)


def _delete_references(spec: mujoco.MjSpec, root: mujoco.MjsBody) -> None:
    """Delete the equality constraints and contact exclusions that refer to a body or joint of a tree."""
    gone = {root.name, *(body.name for body in root.find_all("body"))}
    gone |= {joint.name for joint in root.find_all("joint")}
    for equality in list(spec.equalities):
        if equality.name1 in gone or equality.name2 in gone:
            spec.delete(equality)
    for exclude in list(spec.excludes):
        if exclude.bodyname1 in gone or exclude.bodyname2 in gone:
            spec.delete(exclude)


def _rename(spec: mujoco.MjSpec) -> None:
    """Remove the temporary prefix from the names of bodies, joints, sites and geoms, and name those without a name."""
    kinds = {"body": spec.bodies, "joint": spec.joints, "site": spec.sites, "geom": spec.geoms}
    for label, kind in kinds.items():
        taken = {item.name.removeprefix(TAKEOVER) for item in kind}
        for number, item in enumerate(kind):
            name = item.name.removeprefix(TAKEOVER)
            if not name:
                name = f"{label}_{number}"
                while name in taken:
                    name += "_"
            if item.name != name:
                item.name = name
    for equality in spec.equalities:
        equality.name1 = equality.name1.removeprefix(TAKEOVER)
        equality.name2 = equality.name2.removeprefix(TAKEOVER)
    for exclude in spec.excludes:
        exclude.bodyname1 = exclude.bodyname1.removeprefix(TAKEOVER)
        exclude.bodyname2 = exclude.bodyname2.removeprefix(TAKEOVER)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmChain:
    """Joints and bodies of an arm and its gripper.

    Attributes:
        joints: Names of the arm joints in the requested order.
        last_body: Id of the body that the last arm joint moves.
        hand_bodies: Ids of the gripper's bodies, which are the descendants of the last arm body.
        hand_joints: Names of the finger joints.
    """

    joints: tuple[str, ...]
    last_body: int
    hand_bodies: tuple[int, ...]
    hand_joints: tuple[str, ...]


def arm_chain(model: mujoco.MjModel, joints: Sequence[str], path: Path) -> ArmChain:
    """Determine the arm that consists of given joints.

    Args:
        model: Compiled model of the robot.
        joints: Names of the arm joints in any order.
        path: File of the robot, for messages.

    Raises:
        MalformedFileError: A name is unknown, the joints are on several branches, or a joint is neither listed nor part of
            the gripper.
    """
    known = [model.joint(j).name for j in range(model.njnt)]
    absent = [name for name in joints if name not in known]
    if absent:
        raise MalformedFileError(
            path, f"has no joint '{absent[0]}'", f"name its own in robot.joints: {', '.join(known)}"
        )
    bodies = [int(model.jnt_bodyid[known.index(name)]) for name in joints]
    last = max(bodies, key=lambda body: len(ancestors(model, body)))
    line = {last, *ancestors(model, last)}
    aside = [name for name, body in zip(joints, bodies, strict=True) if body not in line]
    if aside:
        raise MalformedFileError(
            path,
            f"has joint '{aside[0]}' on another branch than the other arm joints",
            "list one arm's joints",
        )
    hand = tuple(body for body in range(1, model.nbody) if last in ancestors(model, body))
    below = {last, *hand}
    hand_joints = tuple(
        known[j] for j in range(model.njnt) if model.jnt_bodyid[j] in below and known[j] not in joints
    )
    left = [name for name in known if name not in joints and name not in hand_joints]
    if left:
        raise MalformedFileError(
            path,
            f"has joint '{left[0]}', which is neither listed in robot.joints nor part of the gripper",
            "log it too, or fix it in the file",
        )
    return ArmChain(joints=tuple(joints), last_body=last, hand_bodies=hand, hand_joints=hand_joints)


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """List the ids of the ancestors of a body without the world, nearest first."""
    result = []
    while body := int(model.body_parentid[body]):
        result.append(body)
    return result
