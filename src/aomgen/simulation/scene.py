"""Compile robot, table and articulated object into one MuJoCo model, and find the addresses of their parts."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.assets.mjcf import AssetNames
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import OrientedBox
from aomgen.core.demonstration import SupportPlane
from aomgen.core.episode import FINGERS
from aomgen.core.joint import Joint
from aomgen.core.transforms import matrix_from_quat, quat_from_matrix, transform
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.robots.robot import HandDrive, RobotModel
from aomgen.simulation.scene_spec import OBSTACLES, TABLE, scene_spec

# A drive may exceed its torque limit by this factor briefly; the pass rule limits its moving average. At a hard limit, the
# derivative of the force with respect to the velocity is 0 for the implicit integrator, so that a nearly straight arm, whose
# joints can move against each other with little inertia, would oscillate at every step of the commanded velocity.
PEAK = 1.5

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmDrive:
    """Addresses of the arm's joints and actuators in the model, and their properties (J,).

    `kp` is the stiffness, [N m/rad], `kv` the damping, [N m s/rad], and `torques` the largest torque, [N m], infinite if the
    model states none. For prismatic joints, the units are [N/m], [N s/m] and [N].
    """

    qpos: Indices
    dofs: Indices
    actuators: Indices
    kp: Array
    kv: Array
    torques: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class GeomRoles:
    """Masks and finger indices of the geoms (G,) of the model.

    Attributes:
        robot, gripper, table, obstacle, static, moving, handle: Masks; gripper is a subset of robot, handle of moving.
        finger: Index of the finger to which a pad belongs (0 left, 1 right); -1 for other geoms.
    """

    robot: Mask
    gripper: Mask
    table: Mask
    obstacle: Mask
    static: Mask
    moving: Mask
    handle: Mask
    finger: Indices

    @property
    def object(self) -> Mask:
        """Mask of both links of the object."""
        return self.static | self.moving


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A compiled scene. The model is not changed after construction: `place_at` returns another scene.

    Attributes:
        model: Model of the robot, the table and an object with a passive joint.
        robot: The robot.
        asset: The object.
        names: Names of the object's elements in the model.
        arm: Drives of the arm.
        gripper: Actuation of the gripper.
        roles: Masks of the geoms.
        object_qpos, object_dof: Addresses of the object's joint.
        object_body: Id of the object's static link.
        ee_site: Id of the end-effector site.
        bolted: The object's base is fixed to the world.
        clearance: Distance that the arm keeps from the object in checks without dynamics, [m].
        gripper_clearance: Distance that the gripper keeps from the object's static link in these checks, [m].
    """

    model: mujoco.MjModel
    robot: RobotModel
    asset: ArticulatedAsset
    names: AssetNames
    arm: ArmDrive
    gripper: HandDrive
    roles: GeomRoles
    object_qpos: int
    object_dof: int
    object_body: int
    ee_site: int
    bolted: bool
    clearance: float = 0.0
    gripper_clearance: float = 0.0

    @property
    def joint_world(self) -> Joint:
        """The object's joint, world frame."""
        body = self.object_body
        R = matrix_from_quat(self.model.body_quat[body])
        return self.asset.joint.move(transform(R, self.model.body_pos[body]))

    def place_at(
        self, T_world_object: ArrayLike, clearance: float = 0.0, gripper_clearance: float = 0.0
    ) -> "Scene":
        """Return the scene with the object at a pose (4, 4), and with other clearances, [m]."""
        model = copy.copy(self.model)
        T = np.asarray(T_world_object, np.float64)
        body = self.object_body
        model.body_pos[body] = T[:3, 3]
        model.body_quat[body] = quat_from_matrix(T[:3, :3])
        if self.names.free_joint:
            address = model.joint(self.names.free_joint).qposadr[0]
            model.qpos0[address : address + 7] = np.append(T[:3, 3], quat_from_matrix(T[:3, :3]))
        # Contacts below this distance are reported, without a force.
        reported = max(clearance, gripper_clearance)
        model.geom_gap[self.roles.object] = reported
        # MuJoCo discards pairs of bodies whose bounding boxes are farther apart than this margin.
        model.body_margin[model.geom_bodyid[self.roles.object]] = reported
        return replace(self, model=model, clearance=clearance, gripper_clearance=gripper_clearance)

    def qpos(self, joints: ArrayLike, gripper: ArrayLike, thetas: ArrayLike) -> Array:
        """Compute generalized positions (T, nq) from arm joints (T, J), gripper (T,) and object joint (T,)."""
        joints = np.atleast_2d(np.asarray(joints, np.float64))
        result = np.repeat(self.model.qpos0[None], len(joints), 0)
        result[:, self.arm.qpos] = joints
        table = self.robot.gripper_table
        if fingers := [self.model.joint(name).qposadr[0] for name in table.joint_names]:
            result[:, fingers] = table.at(np.broadcast_to(gripper, len(joints)))
        result[:, self.object_qpos] = thetas
        return result


def build_scene(
    robot: RobotModel,
    asset: ArticulatedAsset,
    T_world_object: ArrayLike,
    support: SupportPlane,
    *,
    damping: float = 0.2,
    frictionloss: float = 0.1,
    bolted: bool = True,
    visual: bool = False,
    obstacles: Sequence[OrientedBox] = (),
) -> Scene:
    """Compile robot, table and object into one model.

    Gravity is compensated on all robot bodies, as the controllers of arms do. The table is a slab below the support plane; a
    side with unknown extent is 0.7 m from the object. The table does not collide with the base of the arm.

    Args:
        robot: Robot with position actuators on all arm joints.
        asset: Object.
        T_world_object: Pose of the object (4, 4).
        support: Plane and extent of the table.
        damping, frictionloss: Resistance of the object's joint, see `add_asset`.
        bolted: Fix the object to the world; otherwise it is held by friction only.
        visual: Also add the visual meshes, for rendering.
        obstacles: Static obstacles, world frame.

    Raises:
        ConfigError: The robot has no position actuators, or no fingers.
    """
    arguments = {"damping": damping, "frictionloss": frictionloss, "bolted": bolted, "visual": visual}
    spec, names = scene_spec(robot, asset, T_world_object, support, obstacles=obstacles, **arguments)
    return describe_scene(spec.compile(), robot, asset, names, bolted=bolted)


def describe_scene(
    model: mujoco.MjModel,
    robot: RobotModel,
    asset: ArticulatedAsset,
    names: AssetNames,
    *,
    bolted: bool = True,
) -> Scene:
    """Find the addresses of robot and object in a model that also contains a geom named `TABLE`.

    Args:
        model: Compiled model; the force limits of the arm's actuators in it are multiplied by `PEAK`.
        robot, asset: Robot and object in the model.
        names: Names of the object's elements in the model.
        bolted: The object is fixed to the world.

    Raises:
        ConfigError: The robot has no position actuators, or no fingers.
    """
    arm = _arm_drive(model, robot)
    if robot.drive is None:
        problem = f"'{robot.name}' has no fingers that could hold"
        raise ConfigError("robot", problem, "use the file of the arm with its gripper")
    joint = model.joint(names.joint)
    return Scene(
        model=model,
        robot=robot,
        asset=asset,
        names=names,
        arm=arm,
        gripper=robot.drive,
        roles=_geom_roles(model, robot, names),
        object_qpos=int(joint.qposadr[0]),
        object_dof=int(joint.dofadr[0]),
        object_body=model.body(names.static_body).id,
        ee_site=model.site(robot.ee_site).id,
        bolted=bolted,
    )


def _arm_drive(model: mujoco.MjModel, robot: RobotModel) -> ArmDrive:
    joints = [model.joint(name) for name in robot.joint_names]
    actuators = []
    for joint in joints:
        driving = np.flatnonzero(
            (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint.id)
        )
        if len(driving) != 1 or model.actuator_biastype[driving[0]] != mujoco.mjtBias.mjBIAS_AFFINE:
            raise ConfigError(
                "robot.model",
                f"joint '{joint.name}' has no position actuator",
                "add one to the model, or use ur5e_2f85",
            )
        actuators.append(int(driving[0]))
    ids, numbers = np.array(actuators, np.int64), [joint.id for joint in joints]
    drive = ArmDrive(
        qpos=np.array([joint.qposadr[0] for joint in joints], np.int64),
        dofs=np.array([joint.dofadr[0] for joint in joints], np.int64),
        actuators=ids,
        kp=-model.actuator_biasprm[ids, 1],
        kv=-model.actuator_biasprm[ids, 2],
        torques=np.minimum(
            np.where(model.actuator_forcelimited[ids], model.actuator_forcerange[ids, 1], np.inf),
            np.where(model.jnt_actfrclimited[numbers], model.jnt_actfrcrange[numbers, 1], np.inf),
        ),
    )
    model.actuator_forcerange[ids] *= PEAK
    model.jnt_actfrcrange[numbers] *= PEAK
    return drive


def _geom_roles(model: mujoco.MjModel, robot: RobotModel, names: AssetNames) -> GeomRoles:
    bodies = [model.body(b).name for b in model.geom_bodyid]
    robot_bodies = set(robot.body_names)
    hand = set(robot.hand_bodies)

    def mask(geoms: tuple[str, ...]) -> Mask:
        result = np.zeros(model.ngeom, bool)
        result[[model.geom(name).id for name in geoms]] = True
        return result

    finger = np.full(model.ngeom, -1, np.int64)
    for index, side in enumerate(FINGERS):
        for name in robot.pad_geoms.get(side, ()):
            finger[model.geom(name).id] = index
    finger.flags.writeable = False
    return GeomRoles(
        robot=np.array([name in robot_bodies for name in bodies]),
        gripper=np.array([name in hand for name in bodies]),
        table=mask((TABLE,)),
        obstacle=np.array([name == OBSTACLES for name in bodies]),
        static=mask(names.static_geoms),
        moving=mask(names.moving_geoms),
        handle=mask(names.handle_geoms),
        finger=finger,
    )
