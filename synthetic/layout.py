"""Poses of all objects in a synthetic capture, and the MuJoCo model of it."""

from dataclasses import dataclass

import numpy as np

from aomgen.assets.asset_check import outward_normal
from aomgen.assets.mjcf import add_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import add_robot_visuals
from aomgen.simulation.scene import Scene, describe_scene
from synthetic.room import FRONT_M, Room, add_room

# Resolution of the robot's meshes, [m]: less than a pixel in these images.
ROBOT_CELL_M = 0.0025
# The passive joint: (damping, dry friction) in [N m s/rad], [N m] or [N s/m], [N].
RESISTANCE = {"revolute": (0.35, 0.25), "prismatic": (4.0, 2.0)}
# The arm follows the handle over about this much of the joint, [rad] or [m].
FOLLOWED = {"revolute": np.deg2rad(60.0), "prismatic": 0.2}
# Yaw of the object, [deg], and distance of the handle before the robot, [m]. A lid leads the end effector up,
# over and away from the robot: the arm has room for 90 degrees of that where the object stands near and
# is turned with its front across the robot's middle (searched over 360 places of three toolboxes and
# three laptops).
BEFORE, LIFTED = ((-18.0, 18.0), (0.56, 0.70)), ((-8.0, 52.0), (0.38, 0.52))
# An object this low lies where people work, [m]: on a mat, with clutter around it.
LOW_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneLayout:
    """One scene: an object, closed at joint value 0, on a table in front of the robot.

    `room_seed` chooses the room's prints and clutter.
    """

    asset: ArticulatedAsset
    room: Room
    room_seed: int
    T_world_object: Matrix4

    __post_init__ = freeze_arrays

    @property
    def joint_world(self) -> Joint:
        """The object's joint in the world frame."""
        return self.asset.joint.move(self.T_world_object)


def draw_layout(asset: ArticulatedAsset, rng: np.random.Generator) -> SceneLayout:
    """A random pose of the object within the robot's reach; planning decides whether it is enough."""
    heading = rng.uniform(-np.pi, np.pi)
    T_world_room = transform(matrix_from_rotvec([0.0, 0.0, heading]), np.zeros(3))
    table_z = rng.uniform(-0.08, 0.04)
    held, lifted = _held_place(asset)
    turns, distances = LIFTED if lifted else BEFORE
    yaw = np.deg2rad(rng.uniform(*turns))
    # The handle is put where the arm can follow it; the object follows from that.
    handle = np.array([rng.uniform(-0.28, 0.28), rng.uniform(*distances), 0.0])
    R = matrix_from_rotvec([0.0, 0.0, yaw * np.sign(handle[0]) if lifted else yaw])
    centre = handle - R @ (held * [1, 1, 0])
    T_room_object = transform(R, centre + [0.0, 0.0, table_z])
    room = Room(
        T_world_room=T_world_room,
        table_z=table_z,
        table=(-0.85, 0.85, 0.24, 1.32),
        keep_free=_footprint(asset, T_room_object),
        desk=bool(max(asset.static.bounds[1][2], asset.moving.bounds[1][2]) < LOW_M),
        wall_y=1.42,
        floor_z=table_z - 0.74,
    )
    return SceneLayout(
        asset=asset,
        room=room,
        room_seed=int(rng.integers(1 << 31)),
        T_world_object=T_world_room @ T_room_object,
    )


def _held_place(asset: ArticulatedAsset) -> tuple[Array, bool]:
    """Point (3,) of the asset frame that is put before the arm, and whether the part is lifted.

    A part that opens towards the robot is met at its closed handle. A lid or a sliding panel
    carries the handle away or aside, so that the middle of its way counts.
    """
    joint, start = asset.joint, asset.handle_point
    values = np.linspace(0.0, min(FOLLOWED[joint.type], joint.upper), 9)
    way = apply(joint.motion(values), start) - start
    length = float(np.linalg.norm(way[-1]))
    middle = start + (way.min(0) + way.max(0)) / 2
    opens_forward = float(way[-1] @ outward_normal(asset)) > 0.25 * length
    return start if opens_forward else middle, bool(way[-1, 2] > 0.5 * length)


def _footprint(asset: ArticulatedAsset, T_room_object: Array) -> tuple[float, float, float, float]:
    """Part of the table (room frame) that the object covers, open or closed, with some margin."""
    points = [box.corners for box in asset.static.colliders]
    for theta in np.linspace(0.0, asset.joint.upper, 6):
        points += [apply(asset.joint.motion(theta), box.corners) for box in asset.moving.colliders]
    placed = np.concatenate(points) @ T_room_object[:3, :3].T + T_room_object[:3, 3]
    low, high = placed.min(0) - 0.04, placed.max(0) + 0.04
    # Before the front the gripper needs room as well.
    return float(low[0]), float(high[0]), float(low[1]) - FRONT_M, float(high[1])


def build_world(robot: RobotModel, layout: SceneLayout, *, visual: bool) -> Scene:
    """Compile robot, room and object into one model; gravity of the arm is compensated.

    With and without `visual` the joints are the same, so that `qpos` carries over.
    """
    spec = robot.spec(visual=False)
    for name in robot.body_names:
        spec.body(name).gravcomp = 1.0
    add_room(spec, layout.room, np.random.default_rng(layout.room_seed), visual=visual)
    damping, friction = RESISTANCE[layout.asset.joint.type]
    names = add_asset(
        spec, layout.asset, layout.T_world_object, damping=damping, frictionloss=friction, visual=visual
    )
    if visual:
        add_robot_visuals(spec, robot, ROBOT_CELL_M)
        spec.stat.extent, spec.stat.center = 1.6, [0.0, 0.0, 0.0]
        spec.visual.quality.shadowsize = 1024
        spec.visual.headlight.ambient = [0.42, 0.42, 0.42]
        spec.visual.headlight.diffuse = [0.0, 0.0, 0.0]
        spec.visual.headlight.specular = [0.0, 0.0, 0.0]
        spec.visual.map.znear = 0.01
    return describe_scene(spec.compile(), robot, layout.asset, names)
