"""Stages from the twin to the dataset: other objects, other poses, verified and drawn. [paper 4.3, 5.2]"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.check import require_usable
from aomgen.assets.make import make_asset
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import write_usd
from aomgen.capture.read import read_capture
from aomgen.conventions import MOVING, STATIC
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.demonstration import Demonstration, RecordedObject, SupportPlane
from aomgen.core.light import Light
from aomgen.core.plan import FittedAsset, Variation, VerifiedEpisode
from aomgen.core.progress import Progress, part
from aomgen.core.transforms import apply
from aomgen.core.verdict import Rejection
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.stage import run_episodes
from aomgen.episodes.viewpoint import choose_viewpoint
from aomgen.errors import ConfigError, EstimationError, NotEnoughEpisodesError
from aomgen.generalization.ik import IkSolver, ik_solver
from aomgen.generalization.planning import PlanParams, plan_episode
from aomgen.generalization.variations import PoseRanges, longest_reach, variations, worth_trying
from aomgen.io.atomic import write_json
from aomgen.io.episode_folder import camera_dict, list_committed
from aomgen.io.jsonfile import read_json
from aomgen.motion.stage import load_motion
from aomgen.physics.demonstration import demonstration_from
from aomgen.physics.robot import RobotModel
from aomgen.physics.scene import Scene, build_scene
from aomgen.physics.verify import verify_plan
from aomgen.pipeline.plan_store import load_fitted, load_verified, save_fitted, save_verified
from aomgen.pipeline.recovery import demo_camera_world, demo_fps, robot_of, scan_cameras_world, surface_points
from aomgen.pipeline.stage import Run
from aomgen.replacement.extent import free_rectangle
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.replacement.light import estimate_light
from aomgen.replacement.recorded import recorded_contact
from aomgen.replacement.removal import Cleared, clear_object
from aomgen.replacement.support import on_surface
from aomgen.splatting.surfels import surfels_of
from aomgen.twin.binding import with_object
from aomgen.twin.store import load_twin, save_twin
from aomgen.twin.twin import Twin, TwinState, posed

SURFELS = 30_000
# Variations tried for each episode wanted before giving up.
ATTEMPTS = 5
NEW_CAMERA = "side"


def replacement(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """The scene without its object, its light, and every asset fitted to the motion."""
    robot = robot_of(read_capture(run.project.capture))
    twin = load_twin(run.folders["twin"])
    progress(0.0, "removing the object")
    cleared = clear_object(twin, robot, np.random.default_rng(run.project.seed))
    progress(0.3, "light")
    light = estimate_light(twin, robot, np.random.default_rng(run.project.seed))
    support = support_plane(cleared)
    (folder / "background").mkdir()
    save_twin(folder / "background", cleared.twin)
    demo, recorded = recorded_demonstration(run, robot, twin, support)
    contact = recorded_contact(demo, recorded)
    names, residuals = [], []
    for index, spec in enumerate(run.project.assets):
        progress(0.4 + 0.5 * index / len(run.project.assets), f"asset {spec}")
        fitted = fit_asset(open_asset(spec), contact, demo.joint.type, run.project.adapt, FitParams())
        if isinstance(fitted, Rejection):
            raise EstimationError(
                f"asset {spec}", fitted.detail, "choose an asset that opens like the recorded object"
            )
        target = folder / "assets" / f"{index:02d}"
        target.mkdir(parents=True)
        save_fitted(target, fitted)
        write_usd(fitted.asset, target / "asset.usda")
        save_twin(target, asset_twin(cleared.twin, fitted, light.light, run.project.seed + index))
        names.append(fitted.asset.name)
        residuals.append(fitted.residual_mm)
    progress(0.9, "new viewpoint")
    cameras = episode_cameras(run, robot, twin, demo)
    write_json(folder / "cameras.json", {name: camera_dict(camera) for name, camera in cameras.items()})
    write_json(
        folder / "scene.json",
        {
            "light_sh": light.light.radiance_sh,
            "light_source": light.source,
            "T_world_plane": cleared.support.T_world_plane,
            "support": {"height": support.height, "low_xy": support.low_xy, "high_xy": support.high_xy},
        },
    )
    return {"assets": ", ".join(names), "light": light.source, "removed": cleared.removed, "filled": cleared.filled,
            "fit_residual_mm": float(np.max(residuals)) if residuals else 0.0}  # fmt: skip


def plans(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """New poses, retargeted, solved for the arm, and verified in physics."""
    robot = robot_of(read_capture(run.project.capture))
    twin = load_twin(run.folders["twin"])
    support = stored_support(run)
    demo, _ = recorded_demonstration(run, robot, twin, support)
    solver = ik_solver(robot)
    shoulder, reach = longest_reach(robot)
    verified: list[VerifiedEpisode] = []
    attempts: list[dict[str, Any]] = []
    for number, fitted in enumerate(fitted_assets(run)):
        share = part(progress, number / len(run.project.assets), (number + 1) / len(run.project.assets))
        scene = build_scene(robot, fitted.asset, fitted.T_world_asset, support)
        usable = (
            item
            for item in islice(variations(run.project.seed + number, PoseRanges()), 100 * run.project.poses)
            if worth_trying(item, fitted, support, shoulder, reach)
        )
        verified += _until_enough(usable, fitted, demo, scene, solver, run, attempts, share)
    save_verified(folder, verified)
    write_json(folder / "attempts.json", attempts)
    margins = [item.verdict.margin for item in verified]
    return {"verified": len(verified), "tried": len(attempts), "smallest_margin": float(min(margins))}


def episodes(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Every verified plan drawn from both cameras and committed."""
    capture = read_capture(run.project.capture)
    robot = robot_of(capture)
    fitted = fitted_assets(run)
    verified = load_verified(run.folders["plans"], {item.asset.name: item for item in fitted})
    twins = {
        item.asset.name: load_twin(run.folders["replacement"] / "assets" / f"{index:02d}")
        for index, item in enumerate(fitted)
    }
    scene = read_json(run.folders["replacement"] / "scene.json")
    cameras = {
        name: Camera(**values)
        for name, values in read_json(run.folders["replacement"] / "cameras.json").items()
    }
    folders = run_episodes(
        verified,
        twins,
        robot,
        cameras,
        folder,
        instruction=capture.instruction,
        T_world_plane=np.array(scene["T_world_plane"]),
        progress=progress,
    )
    return {"episodes": len(folders), "cameras": ", ".join(cameras)}


def dataset(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """A LeRobot v3.0 dataset of the committed episodes."""
    summary = write_lerobot_v3(list_committed(run.folders["episodes"]), folder, progress)
    return {"episodes": summary.episodes, "frames": summary.frames}


def episode_cameras(run: Run, robot: RobotModel, twin: Twin, demo: Demonstration) -> dict[str, Camera]:
    """The demonstration's camera and a new viewpoint, at the size of the episodes' pictures."""
    first = demo_camera_world(run).resized(*run.project.image_size)
    frames = np.linspace(0, len(demo.times_s) - 1, 4).astype(int)
    held = apply(demo.Ts_world_ee[demo.contact_frames[0]], demo.grasp_ee)
    states = [
        TwinState(
            joints=demo.joints[t],
            gripper=float(demo.gripper[t]),
            theta=float(demo.thetas[t]),
            T_world_object=twin.T_world_object,
        )
        for t in frames
    ]
    key_points = [
        np.stack([demo.Ts_world_ee[t][:3, 3], apply(demo.joint.motion(demo.thetas[t]), held)]) for t in frames
    ]
    chosen = choose_viewpoint(scan_cameras_world(run), first, twin, robot, states, key_points)
    name = read_capture(run.project.capture).cameras[0].name
    return {name: first, NEW_CAMERA: chosen.camera}


def open_asset(spec: str) -> ArticulatedAsset:
    """The asset that a project names: `category:seed`, or a USD file.

    Raises:
        ConfigError: Neither of the two.
        AssetError, InputError: The asset cannot be read or used.
    """
    category, _, seed = spec.partition(":")
    if seed.isdigit():
        asset = replace(make_asset(category, int(seed)), name=f"{category}-{seed}")
    elif Path(spec).suffix in (".usd", ".usda", ".usdc", ".usdz"):
        asset = read_usd(Path(spec))
    else:
        raise ConfigError(
            "assets", f"'{spec}' is neither category:seed nor a USD file", "for example microwave:1"
        )
    require_usable(asset)
    return asset


def asset_twin(background: Twin, fitted: FittedAsset, light: Light, seed: int) -> Twin:
    """The cleared scene with a fitted asset where the recorded object stood."""
    rng = np.random.default_rng(seed)
    static, moving = (
        surfels_of(link.meshes, SURFELS // 2, rng) for link in (fitted.asset.static, fitted.asset.moving)
    )
    return with_object(background, static, moving, fitted.asset.joint, light, fitted.T_world_asset)


def support_plane(cleared: Cleared) -> SupportPlane:
    """The table as physics sees it: its height, and the rectangle that is there and free."""
    support = cleared.support
    world = cleared.twin.gaussians.select(cleared.twin.bodies == 0)
    surface = np.asarray(world.means[on_surface(world, support)], np.float64)[:, :2]
    corners = np.array(
        [[x, y, 0] for x in (support.low[0], support.high[0]) for y in (support.low[1], support.high[1])]
    )
    footprint = apply(support.T_world_plane, corners)[:, :2]
    low, high = free_rectangle(surface, footprint.min(0), footprint.max(0))
    return SupportPlane(height=float(support.T_world_plane[2, 3]), low_xy=low, high_xy=high)


def stored_support(run: Run) -> SupportPlane:
    """The table that the replacement stage found."""
    return SupportPlane(**read_json(run.folders["replacement"] / "scene.json")["support"])


def fitted_assets(run: Run) -> list[FittedAsset]:
    """The fitted assets in the project's order."""
    return [
        load_fitted(run.folders["replacement"] / "assets" / f"{i:02d}")
        for i in range(len(run.project.assets))
    ]


def recorded_demonstration(
    run: Run, robot: RobotModel, twin: Twin, support: SupportPlane
) -> tuple[Demonstration, RecordedObject]:
    """The recorded demonstration and object as later stages use them."""
    capture = read_capture(run.project.capture)
    motion = load_motion(run.folders["motion"])
    demo = demonstration_from(motion, capture.joint_log, robot, demo_fps(run))
    world = posed(twin, robot, twin.scan_state)
    recorded = RecordedObject(
        moving_points_world=surface_points(world, twin.labels, MOVING),
        static_points_world=surface_points(world, twin.labels, STATIC),
        support=support,
    )
    return demo, recorded


def _until_enough(
    usable: Iterator[Variation],
    fitted: FittedAsset,
    demo: Demonstration,
    scene: Scene,
    solver: IkSolver,
    run: Run,
    attempts: list[dict[str, Any]],
    progress: Progress,
) -> list[VerifiedEpisode]:
    """Try variations in order until enough passed; every attempt is recorded with its outcome."""
    wanted = run.project.poses
    passed: list[VerifiedEpisode] = []
    params = PlanParams(fps=demo_fps(run))
    for tried, variation in enumerate(islice(usable, ATTEMPTS * wanted), start=1):
        plan = plan_episode(fitted, demo, variation, scene, solver, params)
        result = plan if isinstance(plan, Rejection) else verify_plan(plan, scene)
        entry = {"asset": fitted.asset.name, "index": variation.index, "x": variation.x, "y": variation.y,
                 "yaw": variation.yaw}  # fmt: skip
        if isinstance(result, Rejection):
            entry |= {
                "passed": False,
                "reason": result.reason,
                "detail": result.detail,
                "metrics": dict(result.metrics),
            }
        else:
            passed.append(result)
            entry |= {
                "passed": True,
                "reason": "",
                "detail": "",
                "metrics": {"margin": result.verdict.margin},
            }
        attempts.append(entry)
        progress(min(1.0, len(passed) / wanted), f"{len(passed)} of {wanted} verified, {tried} tried")
        if len(passed) == wanted:
            return passed
    reasons = [
        entry["reason"] for entry in attempts if not entry["passed"] and entry["asset"] == fitted.asset.name
    ]
    counted = (
        ", ".join(f"{reason} {reasons.count(reason)}" for reason in sorted(set(reasons)))
        or "no pose is in reach"
    )
    raise NotEnoughEpisodesError(
        f"asset {fitted.asset.name}",
        f"{len(passed)} of {wanted} variations passed ({counted})",
        "ask for fewer poses",
    )
