"""Rooms with a closed object of another category next to the tested one."""

from dataclasses import replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.assets.choice import open_asset
from aomgen.conventions import BACKGROUND
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera
from aomgen.core.plan import Variation
from aomgen.core.transforms import apply, similarity
from aomgen.core.values import Array
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.variations import scale_fit
from aomgen.errors import NotEnoughEpisodesError
from aomgen.evaluation.suite import open_results
from aomgen.exports.image_clutter import ClutterPlacer, cover_object, find_footprint
from aomgen.exports.image_scenes import SceneMaker
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.results import Results
from aomgen.twin.twin import TwinModel

# Scale of both objects, because those of full size do not fit on the recorded table side by side.
SCALE: Final = 0.6
# Random seed; number of poses that are tried; their offsets from the recorded object, [m], and yaw, [rad].
SEED, TRIES, OFFSET_M, YAW = 5, 3000, 0.6, np.deg2rad(60.0)


def add_neighbor(run: Path, spec: str) -> None:
    """Place a closed object in the scene of a run, with its appearance in all twins and as an obstacle.

    Args:
        run: Folder of a run with the stage "replacement", whose files are replaced.
        spec: Asset, as in a project.

    Raises:
        NotEnoughEpisodesError: The scene has no room within the arm's reach and in view of all cameras.
    """
    results = open_results(run)
    scene, folder = results.episode_scene, results.folders["replacement"]
    asset = open_asset(spec).transform(similarity(SCALE, np.eye(3), np.zeros(3)))
    T = _find_pose(results, asset)
    placer = ClutterPlacer(scene.light, scene.T_world_plane, (scene.support.low_xy, scene.support.high_xy))
    discs = placer.light_item(cover_object(asset, np.random.default_rng(SEED)), T)
    for number in range(len(results.fitted_assets)):
        home = results.asset_folder(number)
        twin = load_artifact(home, "twin", TwinModel).extend(discs, 0, BACKGROUND)
        save_artifact(home, "twin", twin)
    boxes = (*asset.static.colliders, *asset.moving.colliders)
    obstacles = [OrientedBox(T_world_box=T @ box.T_asset_box, half_extents=box.half_extents) for box in boxes]
    save_artifact(folder, "scene", replace(scene, obstacles=(*scene.obstacles, *obstacles)))


def _find_pose(results: Results, asset: ArticulatedAsset) -> Array:
    """Sample poses (4, 4) at which a policy could open the object, and return the one that hides the recorded object least."""
    place = EpisodeFactory(results, results.folders["episodes"]).place
    tested = scale_fit(results.fitted_assets[0], SCALE)
    center, radius = find_footprint(tested, tested.T_world_asset)
    fitted = SceneMaker(results, (1, 1)).put_in_place(asset)
    rng = np.random.default_rng(SEED)
    target = list_corners(tested.asset, tested.T_world_asset)
    found = list[tuple[float, Array]]()
    for _ in range(TRIES):
        x, y, yaw = rng.uniform(-1, 1, 3) * (OFFSET_M, OFFSET_M, YAW)
        variation = Variation(seed=0, index=0, x=x, y=y, yaw=yaw)
        T = variation.place_at(fitted)
        at, own = find_footprint(fitted, T)
        if np.linalg.norm(at - center) > radius + own and place.screen(variation, fitted) is None:
            body = list_corners(asset, T)
            hidden = [measure_hidden_share(camera, target, body) for camera in place.cameras.values()]
            found.append((max(hidden), T))
    if not found:
        what = f"{asset.name} has no room in {results.out}"
        raise NotEnoughEpisodesError("neighbor", what, "choose another one")
    return min(found, key=itemgetter(0))[1]


def list_corners(asset: ArticulatedAsset, T_world_object: Array) -> Array:
    """List the corners (8, 3) of the bounding box of an object's body, world frame, [m]."""
    return apply(T_world_object, np.array(list(product(*zip(*asset.static.bounds, strict=True)))))


def measure_hidden_share(camera: Camera, target_world: Array, body_world: Array) -> float:
    """Compute the share of the rectangle around the points of a target in an image that a nearer body covers with its own."""
    (target, target_m), (body, body_m) = camera.project(target_world), camera.project(body_world)
    if body_m.mean() > target_m.mean():
        return 0.0
    common = np.minimum(target.max(0), body.max(0)) - np.maximum(target.min(0), body.min(0))
    return float(np.prod(np.maximum(common, 0)) / np.prod(np.ptp(target, axis=0)))
