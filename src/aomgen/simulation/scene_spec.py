"""Editable MuJoCo description of robot, table, obstacles and articulated object."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from aomgen.assets.mjcf import AssetNames, add_asset
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import OrientedBox
from aomgen.core.demonstration import SupportPlane
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel

TABLE, OBSTACLES = "table", "obstacles"
# Thick enough that nothing passes through in one step of the simulation, [m].
TABLE_THICKNESS_M = 0.04
# Half size of the table where its outline is unknown, about the object, [m].
TABLE_REACH_M = 0.7
# The arm's base may be next to the table or reach through its plane; bodies that fewer joints move ignore it.
FOOT_JOINTS = 3


def scene_spec(
    robot: RobotModel,
    asset: ArticulatedAsset,
    T_world_object: ArrayLike,
    support: SupportPlane,
    *,
    obstacles: Sequence[OrientedBox],
    **of_asset: Any,
) -> tuple[mujoco.MjSpec, AssetNames]:
    """Describe the model that `build_scene` compiles, which explains the arguments; `of_asset` as in `add_asset`.

    Returns:
        The description, and the names of the object in it.
    """
    spec = robot.spec(visual=of_asset["visual"])
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    for body in spec.bodies:
        if body.name != "world":
            body.gravcomp = 1.0
    T = np.asarray(T_world_object, np.float64)
    _add_table(spec, robot, support, T[:2, 3])
    _add_obstacles(spec, obstacles)
    return spec, add_asset(spec, asset, T, **of_asset)


def _add_table(spec: mujoco.MjSpec, robot: RobotModel, support: SupportPlane, center_xy: Array) -> None:
    low = np.where(np.isfinite(support.low_xy), support.low_xy, center_xy - TABLE_REACH_M)
    high = np.where(np.isfinite(support.high_xy), support.high_xy, center_xy + TABLE_REACH_M)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 0.05)
    spec.worldbody.add_geom(
        name=TABLE,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[middle[0], middle[1], support.height - TABLE_THICKNESS_M / 2],
        size=[half[0], half[1], TABLE_THICKNESS_M / 2],
        rgba=[0.62, 0.5, 0.38, 1.0],
        group=3,
    )
    for name in _foot_bodies(spec, robot):
        spec.add_exclude(name=f"{TABLE}_{name}", bodyname1="world", bodyname2=name)


def _add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[OrientedBox]) -> None:
    # A separate body, because the arm's base ignores contacts with the world body.
    body = spec.worldbody.add_body(name=OBSTACLES)
    for number, box in enumerate(obstacles):
        body.add_geom(
            name=f"{OBSTACLES}_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.T_world_box[:3, 3],
            quat=quat_from_matrix(box.T_world_box[:3, :3]),
            size=box.half_extents,
            group=3,
        )


def _foot_bodies(spec: mujoco.MjSpec, robot: RobotModel) -> list[str]:
    """Bodies that less than `FOOT_JOINTS` of the robot's joints move."""

    def joints_above(body: mujoco.MjsBody) -> int:
        return 0 if body.name == "world" else len(body.joints) + joints_above(body.parent)

    return [name for name in robot.body_names if joints_above(spec.body(name)) < FOOT_JOINTS]
