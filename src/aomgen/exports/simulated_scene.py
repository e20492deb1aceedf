"""MuJoCo scene of a motion: robot, table, obstacles and object."""

import mujoco
import numpy as np

from aomgen.assets.mjcf import RESISTANCES
from aomgen.conventions import MOVING, STATIC
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import QUANTILES
from aomgen.core.parts import surface_points
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply, invert
from aomgen.episodes.factory import EpisodeFactory
from aomgen.exports.scene_motion import SceneMotion
from aomgen.replacement.original import DOOR_M, box_link, subtract_box
from aomgen.results import Results
from aomgen.simulation.scene import Scene
from aomgen.simulation.scene_spec import TABLE, scene_spec


def simulate_motion_scene(results: Results, motion: SceneMotion) -> Scene:
    """Compile the scene in which the object of a motion was verified; a recorded object consists of boxes."""
    fitted = motion.fitted or fit_recorded_boxes(results)
    scene = EpisodeFactory(results, results.folders["episodes"]).build_scene(fitted)
    return scene.place_at(motion.trajectory.T_world_object)


def describe_nominal(results: Results, scene: Scene, motion: SceneMotion) -> mujoco.MjSpec:
    """Return the description of a scene from `simulate_motion_scene` with visual meshes and the nominal resistance."""
    damping, frictionloss = RESISTANCES[scene.asset.joint.type][0]
    recorded = results.episode_scene
    spec, _ = scene_spec(
        scene.robot,
        scene.asset,
        motion.trajectory.T_world_object,
        recorded.support,
        obstacles=recorded.obstacles,
        damping=damping,
        frictionloss=frictionloss,
        visual=True,
        bolted=scene.bolted,
    )
    # The table is centered at the recorded object and may be lowered.
    table, compiled = spec.geom(TABLE), scene.model.geom(TABLE)
    table.pos, table.size = compiled.pos, compiled.size
    return spec


def fit_recorded_boxes(results: Results) -> FittedAsset:
    """Fit boxes to the points of the recorded object's parts, in the object frame of the twin."""
    twin, to_object = results.twin, invert(results.twin.T_world_object)
    points = (surface_points(results.scene, results.parts.labels, label) for label in (STATIC, MOVING))
    body, part = (np.quantile(apply(to_object, found), QUANTILES, axis=0) for found in points)
    if twin.joint.type == "revolute" and int(np.ptp(part, 0).argmin()) == 1:
        # Points behind the window of a door belong to the interior; -y points out of the front.
        part[1, 1] = min(part[1, 1], max(part[0, 1], body[0, 1]) + DOOR_M)
    pieces = {f"body_{number}": box for number, box in enumerate(subtract_box(body, part))}
    middle = part.mean(0)
    asset = ArticulatedAsset(
        name="recorded object",
        category=results.recorded.category,
        static=box_link("body", pieces),
        moving=box_link("part", {"part": part}),
        joint=twin.joint,
        handle_point=middle,
        handle_axis=np.array([0.0, 0.0, 1.0]),
    )
    last = float(results.demonstration.thetas[-1])
    return FittedAsset(
        asset=asset,
        T_world_asset=twin.T_world_object,
        contact_asset=middle,
        shares=np.array([0.0, 1.0]),
        thetas=np.array([0.0, last]),
        scale=1.0,
        mirrored=False,
        mode="trajectory",
        residual_mm=0.0,
    )
