"""Export of a compiled MuJoCo scene as UsdPhysics: rigid bodies, articulations, joints with limits and drives.

MuJoCo's tree is flattened: every body is an Xform below the robot or the object, and a joint connects it to its parent.
Properties that UsdPhysics does not define (self-collisions, gravity compensation, joint resistance) are written with
the names of the PhysX schemas, which usd-core does not contain.
"""

from collections.abc import Collection, Mapping
from typing import Any, Final

import mujoco
import numpy as np

from aomgen.assets.usd_write import make_identifier, quat_from_x, set_attribute, set_resistance
from aomgen.core.transforms import matrix_from_quat, quat_multiply
from aomgen.core.values import Array
from aomgen.exports.usd_colliders import add_colliders, exclude_contacts
from aomgen.io.mujoco_model import LEAST_MASS
from aomgen.simulation.scene import Scene

ROBOT, OBJECT, PHYSICS_SCENE = "/World/Robot", "/World/Object", "/World/PhysicsScene"
DEGREES: Final = 180 / np.pi  # USD uses degrees
# Smallest principal inertia accepted by USD's validator, [kg m^2].
LEAST_INERTIA: Final = 1e-7


def add_physics(stage: Any, scene: Scene, bodies: Mapping[int, str]) -> dict[int, str]:
    """Write the physics of a scene onto the prims of its bodies.

    Args:
        stage: USD stage with an Xform for every body.
        scene: Compiled scene with the object at its pose.
        bodies: Prim path of each body (id) except the world.

    Returns:
        Prim path of each joint (id).
    """
    from pxr import Gf, UsdPhysics

    model = scene.model
    physics = UsdPhysics.Scene.Define(stage, PHYSICS_SCENE)
    physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    physics.CreateGravityMagnitudeAttr(float(-model.opt.gravity[2]))
    for path in (ROBOT, OBJECT):
        root = stage.GetPrimAtPath(path)
        UsdPhysics.ArticulationRootAPI.Apply(root)
        root.AddAppliedSchema("PhysxArticulationAPI")
        # The links of a gripper overlap by design.
        set_attribute(root, "physxArticulation:enabledSelfCollisions", False)
    for body, path in bodies.items():
        _add_body(stage.GetPrimAtPath(path), model, body)
    joints = {}
    for body, path in bodies.items():
        joints |= _bind_to_parent(stage, model, body, bodies, path.rpartition("/")[0])
    _close_loops(stage, model, bodies)
    for joint, drive in find_drives(scene).items():
        _add_drive(stage.GetPrimAtPath(joints[joint]), model, joint, drive)
    set_resistance(stage.GetPrimAtPath(joints[model.joint(scene.names.joint).id]), scene.asset)
    add_colliders(stage, model, bodies)
    exclude_contacts(stage, model, bodies)
    return joints


def find_drives(scene: Scene) -> dict[int, tuple[float, float, float]]:
    """Return the position servos of arm and gripper, and the springs of the gripper's links, by joint (id).

    Each has a stiffness [N m/rad or N/m], a damping [N m s/rad or N s/m], and a largest torque or force [N m or N].
    An actuator of a tendon drives every joint of the tendon, scaled by the joint's coefficient. A joint that is coupled
    to a driven one, for example that of a gripper's second finger, has the same drive.
    """
    model, arm = scene.model, scene.arm
    drives = {}
    for joint in range(model.njnt):
        stiffness = float(model.jnt_stiffness[joint])
        if stiffness > 0:
            damping = float(model.dof_damping[model.jnt_dofadr[joint]])
            drives[joint] = (stiffness, damping, np.inf)
    for row, actuator in enumerate(arm.actuators):
        joint = int(model.actuator_trnid[actuator, 0])
        drives[joint] = (float(arm.kp[row]), float(arm.kv[row]), float(arm.torques[row]))
    number = model.actuator(scene.gripper.actuator).id
    shares = find_actuated_joints(model, number)
    total = sum(shares.values())
    kp, kv = -model.actuator_biasprm[number, 1], -model.actuator_biasprm[number, 2]
    limited = model.actuator_forcelimited[number]
    most = float(model.actuator_forcerange[number, 1]) if limited else np.inf
    for joint, share in shares.items():
        drives[joint] = (float(share * total * kp), float(share * total * kv), abs(share) * most)
    for joint, (leader, _, _) in find_coupled_joints(model, shares).items():
        drives[joint] = drives[leader]
    return drives


def find_actuated_joints(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """Return the joints (id) that an actuator moves, with the coefficients of its length."""
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
        return {target: 1.0}
    start = int(model.tendon_adr[target])
    wraps = range(start, start + int(model.tendon_num[target]))
    return {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}


def find_coupled_joints(
    model: mujoco.MjModel, driven: Collection[int]
) -> dict[int, tuple[int, float, float]]:
    """Return leader, offset and ratio of each joint (id) that an equality couples to a driven joint."""
    found = {}
    for number in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        follower, leader = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        offset, ratio = (float(value) for value in model.eq_data[number, :2])
        if leader in driven and follower not in driven:
            found[follower] = (leader, offset, ratio)
        elif follower in driven and leader not in driven and leader >= 0:
            found[leader] = (follower, -offset / ratio, 1 / ratio)
    return found


def _add_body(prim: Any, model: mujoco.MjModel, body: int) -> None:
    from pxr import Gf, UsdPhysics

    UsdPhysics.RigidBodyAPI.Apply(prim)
    mass = UsdPhysics.MassAPI.Apply(prim)
    # Zero mass means "unknown" in USD, but MuJoCo models contain links without mass.
    mass.CreateMassAttr(max(float(model.body_mass[body]), LEAST_MASS))
    mass.CreateCenterOfMassAttr(_vec3f(model.body_ipos[body]))
    mass.CreateDiagonalInertiaAttr(_vec3f(np.maximum(model.body_inertia[body], LEAST_INERTIA)))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*(float(x) for x in model.body_iquat[body])))
    if model.body_gravcomp[body] > 0:
        prim.AddAppliedSchema("PhysxRigidBodyAPI")
        set_attribute(prim, "physxRigidBody:disableGravity", True)


def _bind_to_parent(
    stage: Any, model: mujoco.MjModel, body: int, bodies: Mapping[int, str], group: str
) -> dict[int, str]:
    """Define the joint of a body; its values are relative to the pose in the description of the MuJoCo model."""
    from pxr import UsdPhysics

    path, parent = bodies[body], bodies.get(int(model.body_parentid[body]), "")
    count, joint = int(model.body_jntnum[body]), int(model.body_jntadr[body])
    if count > 1:
        raise ValueError(f"body {model.body(body).name} has {count} joints, and USD binds two bodies by one")
    if count and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
        return {}
    anchor, turn = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    if not count:
        item = UsdPhysics.FixedJoint.Define(stage, f"{group}/joints/{path.rpartition('/')[2]}_fixed")
    else:
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        kind = UsdPhysics.PrismaticJoint if slides else UsdPhysics.RevoluteJoint
        item = kind.Define(stage, f"{group}/joints/{make_identifier(model.joint(joint).name)}")
        item.CreateAxisAttr("X")
        if model.jnt_limited[joint]:
            start = model.qpos0[model.jnt_qposadr[joint]]
            low, high = (model.jnt_range[joint] - start) * (1.0 if slides else DEGREES)
            item.CreateLowerLimitAttr(float(low))
            item.CreateUpperLimitAttr(float(high))
        anchor, turn = model.jnt_pos[joint], quat_from_x(model.jnt_axis[joint])
    R = matrix_from_quat(model.body_quat[body])
    sides = (
        (item.CreateBody0Rel, parent, model.body_pos[body] + R @ anchor, quat_multiply(model.body_quat[body], turn)),
        (item.CreateBody1Rel, path, anchor, turn),
    )  # fmt: skip
    _set_frames(item, sides)
    if not count:
        return {}
    axis = drive_axis(item.GetPrim())
    item.GetPrim().AddAppliedSchema(f"PhysxJointAxisAPI:{axis}")
    armature = float(model.dof_armature[model.jnt_dofadr[joint]])
    set_attribute(item.GetPrim(), f"physxJointAxis:{axis}:armature", armature)
    return {joint: str(item.GetPath())}


def _close_loops(stage: Any, model: mujoco.MjModel, bodies: Mapping[int, str]) -> None:
    """Write coincident points of two links, as in a gripper's linkage, as ball joints outside the articulation."""
    from pxr import UsdPhysics

    for number in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT):
        if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
            sites = (int(model.eq_obj1id[number]), int(model.eq_obj2id[number]))
            ends = [(int(model.site_bodyid[site]), model.site_pos[site]) for site in sites]
        else:
            data = model.eq_data[number]
            ends = [(int(model.eq_obj1id[number]), data[:3]), (int(model.eq_obj2id[number]), data[3:6])]
        group = bodies[ends[0][0]].rpartition("/")[0]
        item = UsdPhysics.SphericalJoint.Define(stage, f"{group}/joints/loop_{number}")
        item.CreateExcludeFromArticulationAttr(True)
        straight = np.array([1.0, 0.0, 0.0, 0.0])
        sides = zip((item.CreateBody0Rel, item.CreateBody1Rel), ends, strict=True)
        _set_frames(
            item, [(create, bodies.get(body, ""), point, straight) for create, (body, point) in sides]
        )


def _set_frames(item: Any, sides: Any) -> None:
    """Write bodies and frames (position, quaternion wxyz) of both sides of a joint; no prim means the world."""
    from pxr import Gf

    creators = (
        (item.CreateLocalPos0Attr, item.CreateLocalRot0Attr),
        (item.CreateLocalPos1Attr, item.CreateLocalRot1Attr),
    )
    for (create_body, path, position, quat), (create_position, create_rotation) in zip(
        sides, creators, strict=True
    ):
        if path:
            create_body().SetTargets([path])
        create_position(_vec3f(position))
        create_rotation(Gf.Quatf(*(float(x) for x in quat)))


def _add_drive(prim: Any, model: mujoco.MjModel, joint: int, drive: tuple[float, float, float]) -> None:
    """Add a drive from `find_drives`, whose initial target is the rest position of the joint's spring."""
    from pxr import UsdPhysics

    stiffness, damping, largest = drive
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    unit = 1.0 if slides else DEGREES
    item = UsdPhysics.DriveAPI.Apply(prim, drive_axis(prim))
    item.CreateTypeAttr("force")
    item.CreateStiffnessAttr(stiffness / unit)
    item.CreateDampingAttr(damping / unit)
    if np.isfinite(largest):
        item.CreateMaxForceAttr(largest)
    address = model.jnt_qposadr[joint]
    rest = float(model.qpos_spring[address] - model.qpos0[address]) if model.jnt_stiffness[joint] else 0.0
    item.CreateTargetPositionAttr(rest * unit)


def drive_axis(prim: Any) -> str:
    """Return the name of the drive of a revolute or prismatic joint."""
    from pxr import UsdPhysics

    return "linear" if prim.IsA(UsdPhysics.PrismaticJoint) else "angular"


def _vec3f(values: Array) -> Any:
    from pxr import Gf

    return Gf.Vec3f(*(float(x) for x in values))
