"""Build the scene in which episodes of an asset are planned and verified."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import mujoco

from aomgen.core.boxes import OrientedBox
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import FittedAsset
from aomgen.core.values import Array
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import place_scene
from aomgen.simulation.scene import Scene, build_scene

# Distance between the recorded arm and the surface of a table that is lowered below it, [m].
TABLE_CLEARANCE_M = 0.005


def episode_scene(
    robot: RobotModel,
    fitted: FittedAsset,
    demo: Demonstration,
    support: SupportPlane,
    obstacles: Sequence[OrientedBox] = (),
    *,
    bolted: bool = True,
) -> Scene:
    """Build robot, table, obstacles and asset.

    If the recorded arm overlaps with the table, the table is lowered below the arm; for an object that is not bolted, it
    keeps its height, because it supports the object.

    Args:
        robot: Robot with position actuators.
        fitted: Asset at the recorded object's pose.
        demo: Recorded motion of the arm.
        support: Estimated table.
        obstacles: Static obstacles, world frame.
        bolted: Fix the object to the world; otherwise it is held by friction only.

    Raises:
        ConfigError: The robot has no position actuators or no fingers.
    """
    build = partial(
        build_scene, robot, fitted.asset, fitted.T_world_asset, bolted=bolted, obstacles=obstacles
    )
    scene = build(support)
    overlap = table_overlap_m(scene, demo.joints)
    if overlap <= 0.0 or not bolted:
        return scene
    lower = replace(support, height=support.height - overlap - TABLE_CLEARANCE_M)
    return build(lower)


def table_overlap_m(scene: Scene, joints: Array) -> float:
    """Compute the largest depth of a recorded arm path (T, J) below the surface of the assumed table, [m].

    A positive depth means that the real table does not extend to the arm, or that its plane is estimated too high.
    """
    data = mujoco.MjData(scene.model)
    deepest = 0.0
    for qpos in scene.qpos(joints, 0.0, 0.0):
        place_scene(scene, data, qpos)
        pairs = data.contact.geom
        touching = scene.roles.table[pairs].any(1) & scene.roles.robot[pairs].any(1)
        deepest = max(deepest, float(-data.contact.dist[touching].min(initial=0.0)))
    return deepest
