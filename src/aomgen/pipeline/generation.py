"""Stages from the twin to the dataset: other objects, other poses, verified and drawn. [paper 4.3, 5.2]"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_closing

from aomgen.alignment.stage import load_alignment
from aomgen.assets.usd_write import write_usd
from aomgen.core.camera import Camera
from aomgen.core.demonstration import Demonstration, RecordedObject, SupportPlane
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.joint_log import JointLog
from aomgen.core.light import Light
from aomgen.core.motion import Direction, MotionEstimate
from aomgen.core.plan import FittedAsset
from aomgen.core.progress import Progress
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.core.verdict import Rejection
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.episodes.stage import run_episodes
from aomgen.episodes.viewpoint import choose_viewpoint
from aomgen.errors import EstimationError
from aomgen.generalization.episode_planning import PlanParams
from aomgen.generalization.generate import GenerationParams
from aomgen.generalization.stage import load_generalization, run_generalization
from aomgen.io.atomic import write_json
from aomgen.io.episode_folder import camera_dict, list_committed
from aomgen.io.jsonfile import read_json
from aomgen.motion.stage import load_motion
from aomgen.pipeline.asset_choice import open_asset
from aomgen.pipeline.fitted_store import load_fitted, save_fitted
from aomgen.pipeline.stage import Run
from aomgen.pipeline.twin_stages import (
    demo_camera_world,
    demo_fps,
    robot_of,
    scan_cameras_world,
    scanned_object,
)
from aomgen.pipeline.working import aligned_capture_of, capture_of
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.replacement.free_space import free_rectangle
from aomgen.replacement.light_estimation import estimate_light
from aomgen.replacement.recorded_motion import recorded_contact
from aomgen.replacement.removal import Cleared, clear_object
from aomgen.replacement.support import seen_from_above
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfels import surfels_of
from aomgen.twin.binding import with_object
from aomgen.twin.store import load_twin, save_twin
from aomgen.twin.twin import Twin, TwinState

# Surfels of an asset, half on each link: one every 7 mm on a surface of 1.5 m2.
SURFELS = 30_000
ASSET_FILE = "asset.usda"
# How far around the object the table is looked for, in which cells, and what counts as seen.
TABLE_REACH_M = 1.0
# Cell of the image in which the table is found, [m]: finer than its outline has to be known.
TABLE_CELL_M = 0.01
# A cell with less accumulated alpha than this was not seen.
SURFACE_ALPHA = 0.15
# Holes of this many cells between Gaussians are closed.
GAP_CELLS = 3


def replacement(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """The scene without its object, its light, and every asset fitted to the motion."""
    if run.project.assets:
        require_opening(load_motion(run.folders["motion"]).direction)
    robot = robot_of(capture_of(run))
    twin = load_twin(run.folders["twin"])
    progress(0.0, "removing the object")
    cleared = clear_object(twin, robot, np.random.default_rng(run.project.seed))
    progress(0.3, "light")
    light = estimate_light(twin, robot, np.random.default_rng(run.project.seed))
    support = support_plane(cleared)
    (folder / "background").mkdir()
    save_twin(folder / "background", cleared.twin)
    demo, recorded = recorded_demonstration(run, robot, support)
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
        write_usd(fitted.asset, target / ASSET_FILE)
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


def require_opening(direction: Direction) -> None:
    """Refuse to make episodes from a demonstration that closes its object.

    Raises:
        EstimationError: It does; assets are put in place closed, and are opened.
    """
    if direction != "opening":
        raise EstimationError(
            "demonstration video",
            "closes the object; episodes are made from demonstrations that open it",
            "record one that opens it, or leave `assets` empty: twin and motion of this one are complete",
        )


def plans(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """New poses, retargeted, solved for the arm, and verified in physics."""
    robot = robot_of(capture_of(run))
    support = stored_support(run)
    demo, _ = recorded_demonstration(run, robot, support)
    params = GenerationParams(
        count=run.project.poses,
        seed=run.project.seed,
        plan=PlanParams(fps=demo_fps(run)),
        cameras=tuple(stored_cameras(run).values()),
    )
    result = run_generalization(fitted_assets(run), demo, robot, support, params, folder, progress)
    margins = [episode.verdict.margin for episode in result.episodes]
    return {
        "verified": len(margins),
        "rejected": len(result.rejected),
        "smallest_margin": float(min(margins, default=0.0)),
    }


def episodes(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Every verified plan drawn from both cameras and committed."""
    capture = capture_of(run)
    robot = robot_of(capture)
    fitted = fitted_assets(run)
    verified = load_generalization(run.folders["plans"], fitted)
    homes = {
        item.asset.name: run.folders["replacement"] / "assets" / f"{index:02d}"
        for index, item in enumerate(fitted)
    }
    scene = read_json(run.folders["replacement"] / "scene.json")
    cameras = stored_cameras(run)
    folders = run_episodes(
        verified,
        {name: load_twin(home) for name, home in homes.items()},
        {name: home / ASSET_FILE for name, home in homes.items()},
        robot,
        cameras,
        folder,
        instruction=capture.instruction,
        joint_zeros_rad=load_alignment(run.folders["alignment"]).joint_zeros_rad,
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
    name = capture_of(run).cameras[0].name
    return {name: first, NEW_CAMERA: chosen.camera}


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
    low, high = support.low - TABLE_REACH_M, support.high + TABLE_REACH_M
    world = cleared.twin.gaussians.select(cleared.twin.bodies == 0)
    _, alpha = seen_from_above(world, support, low, high, TABLE_CELL_M)
    rows, columns = np.nonzero(binary_closing(alpha > SURFACE_ALPHA, iterations=GAP_CELLS))
    xy = low + (np.stack([columns, rows], -1) + 0.5) * TABLE_CELL_M
    xy_corners = [
        [x, y] for x in (support.low[0], support.high[0]) for y in (support.low[1], support.high[1])
    ]

    def in_world(plane_xy: Array) -> Array:
        return apply(support.T_world_plane, np.column_stack([plane_xy, np.zeros(len(plane_xy))]))[:, :2]

    footprint = in_world(np.array(xy_corners))
    free_low, free_high = free_rectangle(in_world(xy), footprint.min(0), footprint.max(0))
    return SupportPlane(height=float(support.T_world_plane[2, 3]), low_xy=free_low, high_xy=free_high)


def stored_support(run: Run) -> SupportPlane:
    """The table that the replacement stage found."""
    return SupportPlane(**read_json(run.folders["replacement"] / "scene.json")["support"])


def stored_cameras(run: Run) -> dict[str, Camera]:
    """The cameras of the episodes' images, world frame, by name."""
    stored = read_json(run.folders["replacement"] / "cameras.json")
    return {name: Camera(**values) for name, values in stored.items()}


def fitted_assets(run: Run) -> list[FittedAsset]:
    """The fitted assets in the project's order."""
    return [
        load_fitted(run.folders["replacement"] / "assets" / f"{i:02d}")
        for i in range(len(run.project.assets))
    ]


def recorded_demonstration(
    run: Run, robot: RobotModel, support: SupportPlane
) -> tuple[Demonstration, RecordedObject]:
    """The recorded demonstration and object as later stages use them."""
    capture = aligned_capture_of(run)
    motion = load_motion(run.folders["motion"])
    demo = _demonstration(motion, capture.joint_log, robot, demo_fps(run))
    moving, static = scanned_object(run)
    recorded = RecordedObject(moving_points_world=moving, static_points_world=static, support=support)
    return demo, recorded


def _demonstration(motion: MotionEstimate, log: JointLog, robot: RobotModel, fps: float) -> Demonstration:
    """Sample the recorded demonstration at a constant rate.

    Args:
        motion: Recovered motion; brings the video's times and the clock offset.
        log: Joint log on its own clock; its noise is averaged over a sample's length.
        robot: For the end effector's poses.
        fps: Samples a second.

    Returns:
        Samples from the first to the last video frame.
    """
    first, last = float(motion.times_s[0]), float(motion.times_s[-1])
    times = first + np.arange(int((last - first) * fps + 1e-6) + 1) / fps
    # Five readings about each sample, within half a sample, take most of the log's noise away.
    offsets = np.linspace(-0.25, 0.25, 5) / fps
    readings = [log.at(times + offset + motion.clock_offset_s) for offset in offsets]
    joints = np.mean([joints for joints, _ in readings], 0)
    gripper = np.clip(np.mean([gripper for _, gripper in readings], 0), 0.0, 1.0)
    return Demonstration(
        times_s=times,
        joints=joints,
        gripper=gripper,
        Ts_world_ee=robot.ee_poses(joints),
        thetas=motion.theta_at(times),
        start_s=motion.start_s,
        end_s=motion.end_s,
        joint=motion.joint,
        grasp_ee=motion.grasp_ee,
        ee_turn_ratio=motion.ee_turn_ratio,
    )
