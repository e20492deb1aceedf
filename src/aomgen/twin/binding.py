"""Build twins: attach scanned Gaussians to bodies, and replace the recorded object by an asset."""

from dataclasses import replace
from typing import Final

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

# Horizontal share of the unit normal of a part below which the part is a lid.
LEVEL_SHARE: Final = 0.5


def bind(
    gaussians_world: Gaussians,
    labels: NDArray[np.uint8],
    robot_bodies: NDArray[np.int32],
    robot: RobotModel,
    joint_world: Joint,
    scan_state: TwinState,
) -> TwinModel:
    """Attach the Gaussians of an aligned scan to the bodies of robot and object.

    Args:
        gaussians_world: N Gaussians, world frame.
        labels: Part labels (N,), see `conventions.PART_LABELS`.
        robot_bodies: Index into `robot.body_names` (N,), -1 for Gaussians without a robot link. Gaussians that are labeled
            robot, but have no link, are attached to the world.
        robot: Robot in the scene.
        joint_world: Joint of the object, world frame.
        scan_state: State during the scan; its `T_world_object` becomes the object's pose.

    Returns:
        Twin whose Gaussians are in the frames of their bodies.
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
    """Compute the pose T_world_object (4, 4) of a recorded object from its points.

    The origin is the center of the static part's footprint at its lowest level, and the z axis is vertical. The -y axis
    points out of the front: for a prismatic joint, it is the horizontal direction of the axis; for a door, the outward normal
    of the moving part; for a lid, the direction away from the hinge.

    Args:
        static_points_world: Points of the static part (N, 3), [m].
        joint_world: Joint, world frame.
        moving_points_world: Points of the moving part (M, 3), [m].
    """
    static, moving = np.asarray(static_points_world, np.float64), np.asarray(moving_points_world, np.float64)
    low, high = np.quantile(static, 0.02, axis=0), np.quantile(static, 0.98, axis=0)
    if joint_world.type == "prismatic":
        front = np.array(joint_world.axis)
    else:
        # The part is a plate: the direction of its smallest extent is the normal of the front, oriented outward.
        centred = moving - np.median(moving, 0)
        front = np.linalg.svd(centred[:: max(len(centred) // 4000, 1)], full_matrices=False)[2][2]
        front = front * np.sign(front @ (np.median(moving, 0) - (low + high) / 2) or 1.0)
    front[2] = 0
    if np.linalg.norm(front) < LEVEL_SHARE:  # The part is a lid, whose front is opposite the hinge.
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
    """Add an asset at a pose to a scene from which the recorded object was removed.

    Args:
        background: Twin without the recorded object.
        static, moving: Surfels of the asset's links, asset frame at joint value 0.
        joint: Joint of the asset, asset frame.
        light: Light on the asset.
        T_world_object: Pose of the asset (4, 4).
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
