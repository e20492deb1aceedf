"""The scene in which episodes of an asset are planned and verified."""

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

# Kept between the recorded arm and a table that it would have hit, [m].
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
    """Build robot, table, obstacles and asset; a table that the recorded arm would have hit is lowered below it.

    An object that is not bolted needs its table where it is.
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
    """Return how deep a path that a real arm has taken (T, J) dips into the assumed table, [m].

    A positive depth means that the real table ends before the arm, or that its plane is estimated too high.
    """
    data = mujoco.MjData(scene.model)
    deepest = 0.0
    for qpos in scene.qpos(joints, 0.0, 0.0):
        place_scene(scene, data, qpos)
        pairs = data.contact.geom
        touching = scene.roles.table[pairs].any(1) & scene.roles.robot[pairs].any(1)
        deepest = max(deepest, float(-data.contact.dist[touching].min(initial=0.0)))
    return deepest
