"""Build twins: fix scanned Gaussians to bodies, put another object in the recorded one's place."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.joint import Joint
from aomgen.core.light import Light
from aomgen.core.transforms import invert, transform
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfels import Surfels
from aomgen.twin.relighting import Relit, join_relit
from aomgen.twin.twin import OBJECT, PART, TwinModel, TwinState, body_list, body_poses, move_bodies


def bind(
    gaussians_world: Gaussians,
    labels: NDArray[np.uint8],
    robot_bodies: NDArray[np.int32],
    robot: RobotModel,
    joint_world: Joint,
    scan_state: TwinState,
) -> TwinModel:
    """Fix the Gaussians (N) of an aligned scan to the bodies they belong to.

    Args:
        labels: (N,) part labels, see `conventions.PART_LABELS`.
        robot_bodies: (N,) index into `robot.body_names`, -1 where a Gaussian is not of the robot. What is labelled
            robot without a link stays with the world.
        scan_state: State during the scan; its `T_world_object` becomes the object's pose.
    """
    names = body_list(robot)
    bodies = np.zeros(len(gaussians_world), np.int32)
    bodies[labels == STATIC] = names.index(OBJECT)
    bodies[labels == MOVING] = names.index(PART)
    linked = (labels == ROBOT) & (robot_bodies >= 0)
    bodies[linked] = robot_bodies[linked] + 1
    twin = TwinModel(
        robot=robot.name,
        gaussians=gaussians_world,
        bodies=bodies,
        labels=labels,
        body_names=names,
        joint=joint_world.move(invert(scan_state.T_world_object)),
        T_world_object=scan_state.T_world_object,
        scan_state=scan_state,
    )
    Ts_body_world = invert(body_poses(twin, robot, scan_state))
    return replace(twin, gaussians=move_bodies(gaussians_world, bodies, Ts_body_world))


def object_frame(static_points_world: ArrayLike, joint_world: Joint, moving_points_world: ArrayLike) -> Array:
    """Pose T_world_object (4, 4) of a recorded object from its points.

    Origin: middle of the static part's footprint, at its lowest level. Yaw: -y points out of the
    front, which is where the moving part lies as seen from the static part's middle; for a
    sliding part, along its axis.
    """
    static, moving = np.asarray(static_points_world, np.float64), np.asarray(moving_points_world, np.float64)
    low, high = np.quantile(static, 0.02, axis=0), np.quantile(static, 0.98, axis=0)
    if joint_world.type == "prismatic":
        front = np.array(joint_world.axis)
    else:
        # The part is a plate: its thinnest direction is the front's normal, signed outward.
        centred = moving - np.median(moving, 0)
        front = np.linalg.svd(centred[:: max(len(centred) // 4000, 1)], full_matrices=False)[2][2]
        front = front * np.sign(front @ (np.median(moving, 0) - (low + high) / 2) or 1.0)
    front[2] = 0
    if np.linalg.norm(front) < 1e-6:  # a lid: its front is away from the hinge
        front = np.median(moving, 0) - joint_world.origin
        front = front - (front @ joint_world.axis) * joint_world.axis
        front[2] = 0
    back = -front / max(float(np.linalg.norm(front)), 1e-12)
    R = np.stack([np.cross(back, [0, 0, 1.0]), back, [0, 0, 1.0]], 1)
    local = static @ R
    low, high = np.quantile(local, 0.02, axis=0), np.quantile(local, 0.98, axis=0)
    return transform(R, R @ np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]))


def with_object(
    background: TwinModel,
    static: Surfels,
    moving: Surfels,
    joint: Joint,
    light: Light,
    T_world_object: ArrayLike,
) -> TwinModel:
    """A twin in which an asset stands on the cleared scene, at a pose (4, 4).

    Args:
        background: Twin whose recorded object was removed.
        static, moving: The asset's links, asset frame at joint value 0.
        joint: The asset's joint, asset frame.
        light: Light on the asset.
    """
    cleared = background.select(~np.isin(background.labels, (STATIC, MOVING)))
    counts = [len(static.gaussians), len(moving.gaussians)]
    lit = Relit(
        indices=len(cleared.gaussians) + np.arange(sum(counts)),
        albedo_linear=np.concatenate([static.albedo_linear, moving.albedo_linear]),
        transfer=np.concatenate([static.transfer, moving.transfer]),
        light_of=np.zeros(sum(counts), np.int32),
        lights=(light,),
    )
    return cleared.extend(
        concatenate([static.gaussians, moving.gaussians]),
        np.repeat([cleared.body(OBJECT), cleared.body(PART)], counts),
        np.repeat([STATIC, MOVING], counts),
        joint=joint,
        T_world_object=T_world_object,
        scan_state=replace(cleared.scan_state, theta=0.0, T_world_object=T_world_object),
        relit=join_relit(cleared.relit, lit),
    )
