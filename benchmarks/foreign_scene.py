"""A MuJoCo scene from an exported USD file alone, as another importer would build it.

The product's own reader, scene and simulator are not used here, so any knowledge of theirs that is missing in
the file makes the replay fail.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.robots.robot import RobotModel

STATIC, MOVING, JOINT = "foreign_static", "foreign_moving", "foreign_joint"


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignScene:
    """A compiled scene.

    Attributes:
        model: Robot and object.
        arm, dofs: Addresses of arm joints in qpos and qvel (J,).
        actuators: Actuators of the arm (J,).
        gripper: Actuator of the gripper.
        control_range: Its control at gripper 0 and 1.
        ee_site: Id of the end effector.
        theta, theta_dof: Addresses of the object's joint in qpos and qvel.
        pads: Geoms with which the fingers hold.
        moving: Body of the object's moving link.
        resistances: Damping and dry friction of its joint: the file's own, then the other verified settings.
        category: Category of the object.
        revolute: Whether its joint is revolute.
    """

    model: mujoco.MjModel
    arm: list[int]
    dofs: list[int]
    actuators: list[int]
    gripper: int
    control_range: tuple[float, float]
    ee_site: int
    theta: int
    theta_dof: int
    pads: list[int]
    moving: int
    resistances: list[tuple[float, float]]
    category: str
    revolute: bool


def foreign_scene(robot: RobotModel, usd: Path, T_world_object: Array) -> ForeignScene:
    """Place the object of a USD file next to a robot.

    Args:
        robot: Robot with position actuators; its bodies are gravity compensated here.
        usd: File in metres, Z up, one joint between two links of cubes, as `assets.usd_write` writes it.
        T_world_object: Pose of the file's root (4, 4).

    Raises:
        ConfigError: The robot has no gripper.
    """
    from pxr import Usd, UsdPhysics

    if robot.drive is None:
        raise ConfigError(
            "robot", f"'{robot.name}' has no gripper", "replay episodes of a robot that has one"
        )
    stage = Usd.Stage.Open(str(usd))
    joint = next(prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint))
    spec = robot.spec(visual=False)
    for body in spec.bodies:
        body.gravcomp = 1.0
    static = spec.worldbody.add_body(name=STATIC, pos=T_world_object[:3, 3], quat=_quat(T_world_object))
    moving = static.add_body(name=MOVING)
    for body, relation in ((static, "physics:body0"), (moving, "physics:body1")):
        _add_link(body, stage.GetPrimAtPath(joint.GetRelationship(relation).GetTargets()[0]))
    _add_joint(moving, joint)
    # A parent that is welded to the world collides with its child in MuJoCo, unlike the two
    # bodies of a joint in USD.
    spec.add_exclude(bodyname1=STATIC, bodyname2=MOVING)
    model = spec.compile()
    return ForeignScene(
        model=model,
        arm=[int(model.joint(name).qposadr[0]) for name in robot.joint_names],
        dofs=[int(model.joint(name).dofadr[0]) for name in robot.joint_names],
        actuators=[_actuator_of(model, model.joint(name).id) for name in robot.joint_names],
        gripper=model.actuator(robot.drive.actuator).id,
        control_range=robot.drive.control_range,
        ee_site=model.site(robot.ee_site).id,
        theta=int(model.joint(JOINT).qposadr[0]),
        theta_dof=int(model.joint(JOINT).dofadr[0]),
        pads=[model.geom(name).id for names in robot.pad_geoms.values() for name in names],
        moving=model.body(MOVING).id,
        resistances=_resistances(joint),
        category=str(stage.GetDefaultPrim().GetAttribute("aomgen:category").Get()),
        revolute=joint.IsA(UsdPhysics.RevoluteJoint),
    )


def _add_link(body: mujoco.MjsBody, prim: Any) -> None:
    """Add box geoms of the colliders below a rigid body's prim, which share its mass by volume."""
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    cubes = [p for p in Usd.PrimRange(prim) if p.HasAPI(UsdPhysics.CollisionAPI)]
    poses = [np.array(UsdGeom.Xformable(cube).GetLocalTransformation()).T for cube in cubes]
    halves = [np.linalg.norm(pose[:3, :3], axis=0) * UsdGeom.Cube(c).GetSizeAttr().Get() / 2
              for pose, c in zip(poses, cubes, strict=True)]  # fmt: skip
    volume = sum(np.prod(half) for half in halves)
    mass = UsdPhysics.MassAPI(prim).GetMassAttr().Get()
    for cube, pose, half in zip(cubes, poses, halves, strict=True):
        material = UsdShade.MaterialBindingAPI(cube).ComputeBoundMaterial("physics")[0].GetPrim()
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=pose[:3, 3],
            quat=_quat(pose),
            size=half,
            mass=mass * float(np.prod(half)) / volume,
            friction=[
                UsdPhysics.MaterialAPI(material).GetDynamicFrictionAttr().Get(),
                material.GetAttribute("mjc:torsionalfriction").Get(),
                material.GetAttribute("mjc:rollingfriction").Get(),
            ],
        )


def _add_joint(body: mujoco.MjsBody, prim: Any) -> None:
    from pxr import UsdPhysics

    revolute = prim.IsA(UsdPhysics.RevoluteJoint)
    api = UsdPhysics.RevoluteJoint(prim) if revolute else UsdPhysics.PrismaticJoint(prim)
    rotation = UsdPhysics.Joint(prim).GetLocalRot0Attr().Get()
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(
        axis,
        np.eye(3)["XYZ".index(api.GetAxisAttr().Get())],
        np.array([rotation.GetReal(), *rotation.GetImaginary()], np.float64),
    )
    limits = np.array([api.GetLowerLimitAttr().Get(), api.GetUpperLimitAttr().Get()])
    item = body.add_joint(
        name=JOINT,
        type=mujoco.mjtJoint.mjJNT_HINGE if revolute else mujoco.mjtJoint.mjJNT_SLIDE,
        pos=list(UsdPhysics.Joint(prim).GetLocalPos0Attr().Get()),
        axis=axis,
        range=np.deg2rad(limits) if revolute else limits,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=[prim.GetAttribute("mjc:damping").Get(), 0.0, 0.0],
        frictionloss=prim.GetAttribute("mjc:frictionloss").Get(),
        armature=prim.GetAttribute("mjc:armature").Get(),
    )
    if prim.HasAttribute("mjc:solimpfriction"):
        item.solimp_friction = list(prim.GetAttribute("mjc:solimpfriction").Get())


def _resistances(prim: Any) -> list[tuple[float, float]]:
    tried = [prim.GetAttribute(f"aomgen:verified_{name}").Get() for name in ("damping", "frictionloss")]
    own = (prim.GetAttribute("mjc:damping").Get(), prim.GetAttribute("mjc:frictionloss").Get())
    return [own, *list(zip(*tried, strict=True))[1:]]


def _actuator_of(model: mujoco.MjModel, joint: int) -> int:
    drives = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return int(np.flatnonzero(drives)[0])


def _quat(T: Array) -> Array:
    """Compute the quaternion wxyz (4,) of a pose whose axes may be scaled."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (T[:3, :3] / np.linalg.norm(T[:3, :3], axis=0)).ravel())
    return quat
