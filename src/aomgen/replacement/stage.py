"""Replacement stage: the scene without its object, its light, and every asset fitted to the motion. [paper 4.3]"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.choice import ORIGINAL, open_asset, require_usable
from aomgen.assets.doctor import Finding
from aomgen.assets.usd_write import write_for_replay
from aomgen.conventions import MOVING, STATIC
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import EpisodeScene, RecordedObject, SupportPlane
from aomgen.core.parts import surface_points
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.core.progress import Progress
from aomgen.core.project import DIFFUSION_LIGHT, SCAN_LIGHT, Project, split_light
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import EstimationError
from aomgen.io.artifact import save_artifact
from aomgen.io.hdr_image import read_environment
from aomgen.io.images import read_image
from aomgen.lighting.light_estimation import SceneLight, estimate_light, light_of_map
from aomgen.lighting.reflection import show_in_light
from aomgen.lighting.table_shadow import MAX_GAIN
from aomgen.lighting.wall_shadow import cast_wall_shadow
from aomgen.replacement.correspondence import describe_contact
from aomgen.replacement.diffusion import choose_photograph, estimate_environment, inpaint_table
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.replacement.obstacles import find_obstacles, support_plane
from aomgen.replacement.original import fit_original, original_twin
from aomgen.replacement.removal import Cleared, Inpaint, clear_object
from aomgen.replacement.surfel_cache import find_all_surfels
from aomgen.replacement.table_texture import Photograph, inpaint
from aomgen.replacement.viewpoint import episode_cameras
from aomgen.results import ASSET_USD, ASSETS_FOLDER, BACKGROUND_FOLDER, FITTED, Results
from aomgen.robots.robot import longest_reach
from aomgen.splatting.surfels import Surfels
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel, pose_twin


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Remove the object, fit the project's assets, and choose the cameras of the episodes."""
    project = results.project
    progress(0.0, "removing the object")
    views = [
        Photograph(camera=camera, image_srgb=read_image(results.scan_images[name]))
        for name, camera in results.scan_cameras.items()
    ]
    cleared = clear_object(results.twin, results.robot, views, inpainter_of(project))
    progress(0.3, "light")
    support = support_plane(cleared)
    scan_light = _light_at_object(results, cleared)
    background = _remove_wall_shadow(results, cleared, scan_light)
    light = light_of_assets(results, scan_light, choose_photograph(views, _middle(cleared)))
    (folder / BACKGROUND_FOLDER).mkdir()
    save_artifact(folder / BACKGROUND_FOLDER, "twin", background)
    obstacles = find_obstacles(
        cleared.twin.scene, cleared.support, longest_reach(results.robot), results.configuration
    )
    fitted, rejected = fit_assets(results, describe_recorded_object(results, support))
    progress(0.4, "Gaussians of the assets")
    folders = [folder / ASSETS_FOLDER / f"{number:02d}" for number in range(len(fitted))]
    for target, asset in zip(folders, fitted, strict=True):
        target.mkdir(parents=True)
        save_artifact(target, FITTED, asset)
        write_for_replay(asset.asset, target / ASSET_USD)
        if asset.asset.name == ORIGINAL:
            save_artifact(target, "twin", original_twin(background, results.twin, asset))
    others = {number: item.asset for number, item in enumerate(fitted) if item.asset.name != ORIGINAL}
    for count, (number, surfels) in enumerate(find_all_surfels(others, results.workers), 1):
        save_artifact(folders[number], "twin", asset_twin(background, fitted[number], light, surfels))
        progress(0.4 + 0.5 * count / len(others), f"Gaussians of the assets, {count} of {len(others)}")
    progress(0.9, "new viewpoint")
    scene = EpisodeScene(
        support=support,
        obstacles=obstacles,
        T_world_plane=cleared.support.T_world_plane,
        light=light.shown,
        light_source=light.source,
        cameras=episode_cameras(results),
    )
    save_artifact(folder, "scene", scene)
    return {
        "assets": ", ".join(item.asset.name for item in fitted),
        "rejected": len(rejected),
        "light": light.source,
        "removed": cleared.removed,
        "filled": cleared.filled,
        "obstacles": len(obstacles),
        "fit_residual_mm": max((item.residual_mm for item in fitted), default=0.0),
        "warnings": [f"asset {spec} is left out: {found.detail}" for spec, found in rejected.items()],
    }


def inpainter_of(project: Project) -> Inpaint:
    """Return the project's function that completes the image of the table."""
    if project.inpainter:
        return partial(inpaint_table, Path(project.inpainter), seed=project.seed)
    return partial(inpaint, rng=np.random.default_rng(project.seed))


def _light_at_object(results: Results, cleared: Cleared) -> SceneLight:
    """Estimate the light at the center of the recorded object."""
    return estimate_light(
        results.twin,
        results.robot,
        cleared.shadowed,
        _middle(cleared),
        cleared.table,
        list(results.scan_cameras.values()),
        np.random.default_rng(results.project.seed),
    )


def light_of_assets(results: Results, scan_light: SceneLight, view: Photograph) -> SceneLight:
    """Return the light that the project selects for its assets.

    Args:
        results: Results of the previous stages.
        scan_light: Light estimated from the scan and the robot.
        view: A photograph that shows the assets' place.
    """
    project = results.project
    head, path = split_light(project.light)
    if head == SCAN_LIGHT:
        return scan_light
    if head == DIFFUSION_LIGHT:
        world = pose_twin(results.twin, results.robot, results.twin.scan_state)
        around = estimate_environment(Path(path), view, world, project.seed)
        return light_of_map(around, scan_light, "diffusion")
    around = read_environment(Path(path)).turn(np.radians(project.light_yaw_deg))
    return light_of_map(around, scan_light, "file")


def _remove_wall_shadow(results: Results, cleared: Cleared, light: SceneLight) -> TwinModel:
    """Remove the recorded object's shadow from the walls and the clutter of the cleared scene."""
    twin, recorded, T_world_plane = cleared.twin, results.twin, cleared.support.T_world_plane
    body = pose_twin(recorded, results.robot, recorded.scan_state).select(
        np.isin(recorded.labels, (STATIC, MOVING))
    )
    scene, directional = twin.scene, recorded.directional_light
    eyes = np.stack([camera.center for camera in results.scan_cameras.values()])
    received = np.ones((len(twin.gaussians), 1))
    received[twin.of_scene] = cast_wall_shadow(
        scene, body, light.shown, directional, eyes, T_world_plane, len(scene)
    )
    return replace(twin, gaussians=twin.gaussians.illuminate(1 / np.maximum(received, 1 / MAX_GAIN)))


def _middle(cleared: Cleared) -> Array:
    """Compute the center of the recorded object (3,), world frame."""
    support = cleared.support
    middle = np.append((support.low + support.high) / 2, support.top / 2)
    return apply(support.T_world_plane, middle)


def describe_recorded_object(results: Results, support: SupportPlane) -> RecordedObject:
    """Collect the surface points (N, 3) of a run's recorded object, world frame, [m]; `support` is the plane below it."""
    moving, static = (
        surface_points(results.scene, results.parts.labels, label) for label in (MOVING, STATIC)
    )
    return RecordedObject(moving_points_world=moving, static_points_world=static, support=support)


def fit_assets(results: Results, recorded: RecordedObject) -> tuple[list[FittedAsset], dict[str, Rejection]]:
    """Fit the recorded motion to the project's assets; return the fitted assets in the project's order, and a rejection for
    each other asset.

    Raises:
        EstimationError: None fits.
        AssetError: The recorded object itself cannot be simulated and held.
    """
    project, params = results.project, results.params("replacement", FitParams())
    demo = results.demonstration
    contact = describe_contact(demo, recorded, results.motion.direction)
    found: dict[str, FittedAsset | Rejection] = {}
    for spec in project.assets:
        if spec == ORIGINAL:
            original = fit_original(demo, contact, recorded, results.recorded.category)
            require_usable(original.asset)
            found[spec] = original
        else:
            found[spec] = fit_asset(open_asset(spec), contact, demo.joint.type, project.adapt, params)
    rejected = {spec: item for spec, item in found.items() if isinstance(item, Rejection)}
    fitted = [item for item in found.values() if not isinstance(item, Rejection)]
    if rejected and not fitted:
        reasons = "; ".join(f"{spec}: {item.detail}" for spec, item in rejected.items())
        raise EstimationError(
            "assets", f"none fits ({reasons})", "choose assets that move like the recorded object"
        )
    return fitted, rejected


def fit_to_recording(results: Results, asset: ArticulatedAsset) -> FittedAsset | Rejection:
    """Fit an asset to a run's recorded object."""
    recorded = describe_recorded_object(results, results.episode_scene.support)
    contact = describe_contact(results.demonstration, recorded, results.motion.direction)
    params = results.params("replacement", FitParams())
    joint_type = results.demonstration.joint.type
    return fit_asset(asset, contact, joint_type, results.project.adapt, params)


def examine_fit(results: Results, asset: ArticulatedAsset) -> Finding:
    """Report whether an asset can take a run's recorded object's place, for `aomgen assets check`."""
    found = fit_to_recording(results, asset)
    name = f"fit to {results.out.name}"
    if isinstance(found, Rejection):
        return Finding(name=name, state="", problem=f"{found.reason}: {found.detail}")
    return Finding(name=name, state=f"size x {found.scale:.2f}, {found.residual_mm:.1f} mm from the motion")


def asset_twin(
    background: TwinModel, fitted: FittedAsset, light: SceneLight, surfels: tuple[Surfels, Surfels]
) -> TwinModel:
    """Add a fitted asset, whose links are represented by the surfels, to the cleared scene at the recorded object's location."""
    T = fitted.T_world_asset
    static, moving = (show_in_light(link, light, T[:3, :3]) for link in surfels)
    return with_object(background, static, moving, fitted.asset.joint, light.shown, T)
