"""Describe robot, table, obstacles and articulated object as an editable MuJoCo specification."""

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
# Thickness of the table, [m]; no body can pass through it in one simulation step.
TABLE_THICKNESS_M = 0.04
# Distance from the object to a side of the table with unknown extent, [m].
TABLE_REACH_M = 0.7
# Bodies that are moved by fewer joints than this do not collide with the table, because the arm's base may be next to the
# table or intersect its plane.
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
    """Describe the model that `build_scene` compiles.

    Args:
        robot, asset, T_world_object, support, obstacles: See `build_scene`.
        **of_asset: Keyword arguments of `add_asset`.

    Returns:
        The specification, and the names of the object's elements.
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
    # The obstacles have a separate body, because contacts of the arm's base with the world body are excluded.
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
    """List the bodies that are moved by fewer than `FOOT_JOINTS` joints."""

    def joints_above(body: mujoco.MjsBody) -> int:
        return 0 if body.name == "world" else len(body.joints) + joints_above(body.parent)

    return [name for name in robot.body_names if joints_above(spec.body(name)) < FOOT_JOINTS]
