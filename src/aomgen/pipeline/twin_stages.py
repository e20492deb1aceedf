"""Stages from the recording to the twin: what was there, and how it moved. [paper 4.1, 4.2]"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.calibrated_cameras import load_calibrated_cameras
from aomgen.alignment.stage import load_alignment
from aomgen.appearance.drawer_interior import add_drawer_interior
from aomgen.capture.capture_check import read_demo_videos
from aomgen.capture.read import read_capture
from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint import Joint
from aomgen.core.motion import MotionEstimate
from aomgen.core.part_points import surface_points
from aomgen.core.progress import Progress, part
from aomgen.core.recording import Capture
from aomgen.core.values import Array
from aomgen.errors import EstimationError
from aomgen.gaussians.stage import load_gaussians, run_gaussians
from aomgen.gaussians.train import GaussiansParams
from aomgen.io.atomic import write_json
from aomgen.io.video import Video, probe_video
from aomgen.motion.inputs import MotionInput as MotionInput
from aomgen.motion.part_identification import list_warnings
from aomgen.motion.stage import load_motion, run_motion
from aomgen.paper.affinity_features import AffinityParams
from aomgen.paper.affinity_parts import affinity_evidence
from aomgen.paper.automatic_masks import MASKS_FOLDER, segment_views
from aomgen.paper.link_boxes import bodies_in_boxes
from aomgen.paper.motion_estimate import run_paper_motion
from aomgen.paper.true_part_masks import part_masks
from aomgen.parts.coverage import run_survey
from aomgen.parts.label import SEED, Parts, segment_scan
from aomgen.parts.prompted_images import segment_prompts
from aomgen.parts.robot_labels import label_robot
from aomgen.parts.stage import load_parts, save_parts, scan_views
from aomgen.pipeline.estimates import REFUSED_MOTION, estimates_of
from aomgen.pipeline.moving_parts import find_moving_parts
from aomgen.pipeline.posed_videos import pose_demo_video, pose_scan_images, refine_appearance
from aomgen.pipeline.stage import WARNINGS, Run
from aomgen.pipeline.working import aligned_capture_of, capture_of
from aomgen.robots.configuration import RobotPosture
from aomgen.robots.robot import RobotModel, choose_robot
from aomgen.robots.robot_store import save_robot
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.structure.fixed_cameras import DemoView
from aomgen.structure.reconstruct import Photographs
from aomgen.structure.stage import load_structure, run_structure
from aomgen.structure.video_frames import extract_frames
from aomgen.twin.binding import bind, object_frame
from aomgen.twin.store import save_twin
from aomgen.twin.twin import Twin, TwinState

ESTIMATES = "estimates.json"
# The temporal median needs no more frames than this.
MEDIAN_FRAMES = 48


def robot_of(capture: Capture) -> RobotModel:
    """The robot of a capture, with the capture's world frame."""
    return choose_robot(capture.robot)


def structure(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Cameras and sparse points of the scan, fixed cameras in the same model."""
    capture = read_capture(run.project.capture)
    videos = read_demo_videos(capture)
    demo = {
        camera.name: DemoView(
            first_srgb=videos[camera.name].frames_srgb[0],
            median_srgb=_median_frame(videos[camera.name]),
            intrinsics=camera.intrinsics,
        )
        for camera in capture.cameras
    }
    images = {path.name: path for path in capture.scan_images}
    if capture.scan_video is not None:
        prompted = {prompt.image for prompt in capture.prompts}
        images = extract_frames(capture.scan_video, prompted, folder, part(progress, 0.0, 0.2))
        progress = part(progress, 0.2, 1.0)
    photographs = Photographs(
        images=images,
        intrinsics=capture.scan_intrinsics,
        demo=demo,
        prompts=capture.prompts,
    )
    result = run_structure(photographs, capture.mask_folders, folder, progress)
    return {
        "registered": len(result.cameras_recon),
        "of": len(photographs.images),
        "reprojection_error_px": round(result.reprojection_error_px, 3),
        "points": len(result.points_recon),
    }


def _median_frame(video: Video) -> np.ndarray:
    step = max(1, len(video.times_s) // MEDIAN_FRAMES)
    return np.median(video.frames_srgb[::step], axis=0).astype(np.uint8)


def gaussians(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Trained Gaussians of the scene, with held-out views."""
    capture = capture_of(run)
    images = {path.name: path for path in capture.scan_images}
    params = GaussiansParams()
    params = replace(
        params,
        training=replace(
            params.training, iterations=run.project.iterations, max_gaussians=run.project.gaussians
        ),
    )
    scene = run_gaussians(load_structure(run.folders["structure"]), images, folder, progress, params)
    views = list(scene.heldout.values())
    return {
        "gaussians": len(scene.gaussians_recon),
        "heldout_psnr": float(np.mean([view.psnr_db for view in views])) if views else 0.0,
        "heldout_ssim": float(np.mean([view.ssim for view in views])) if views else 0.0,
    }


def parts(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """A part label for every Gaussian, the robot link that carries it, and which sides the scan saw."""
    capture = aligned_capture_of(run)
    scene = load_structure(run.folders["structure"])
    S_world_recon = load_alignment(run.folders["alignment"]).S_world_recon
    world = scanned_world(run.folders)
    posture = posture_of(capture)
    images = {path.name: path for path in capture.scan_images}
    views = scan_views(scene, S_world_recon, images, posture)
    progress(0.1, "robot drawn into the scan")
    if run.project.alignment_method == "paper":
        bodies = bodies_in_boxes(world.means, posture)
    else:
        bodies = label_robot(world, views, posture, np.random.default_rng(SEED))
    progress(0.2, "robot labelled")
    segmenter = choose_segmenter(capture.mask_folders, run.project.segmenter)
    prompted = segment_prompts(views, capture.prompts, segmenter)
    progress(0.4, "prompts answered")
    given = None
    if run.project.parts_method == "saga":
        params, rng = AffinityParams(), np.random.default_rng(SEED)
        masks = segment_views(
            world, views, prompted, segmenter, part(progress, 0.4, 0.45), params.views, folder / MASKS_FOLDER
        )
        given = affinity_evidence(world, views, masks, prompted, part(progress, 0.45, 0.5), params, rng)
    scan = segment_scan(world, views, bodies, prompted, given)
    result = find_moving_parts(scan, partial(motion_input, run), part(progress, 0.5, 1.0))
    save_parts(result, folder)
    found = run_survey(scene, result.cut.applied(world), S_world_recon, result, posture, folder)
    counts = np.bincount(result.labels, minlength=4)
    return {
        "robot": int(counts[ROBOT]),
        "static": int(counts[STATIC]),
        "moving": int(counts[MOVING]),
        "static_agreement": result.static_agreement,
        "moving_agreement": result.moving_agreement,
        "method": result.method,
        "box_misfit": result.box_misfit,
        "coverage": found.figures(),
        WARNINGS: [*result.warnings(), *found.warnings()],
    }


def motion(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """When, where and how the part moved; writes `estimates.json`.

    A refused motion is written there as refused before the error goes on, and its score stays beside it.
    """
    capture = aligned_capture_of(run)
    structure = load_structure(run.folders["structure"])
    S_world_recon = load_alignment(run.folders["alignment"]).S_world_recon
    calibrated = load_calibrated_cameras(run.folders["alignment"])
    cameras_world = {name: item.camera for name, item in calibrated.items()}

    def write_estimates(estimate: MotionEstimate | None, refusals: list[dict[str, str]]) -> None:
        content = estimates_of(
            capture, structure.cameras_recon, cameras_world, S_world_recon, estimate, refusals
        )
        write_json(run.out / ESTIMATES, content)

    try:
        estimate = _recovered_motion(run, folder, progress)
    except EstimationError as error:
        write_estimates(None, [{"quantity": "motion", "reason": str(error)}])
        raise
    write_estimates(estimate, [])
    unit = "deg" if estimate.joint.type == "revolute" else "mm"
    factor = 180 / np.pi if unit == "deg" else 1e3
    return {
        "clock_offset_s": estimate.clock_offset_s,
        "start_s": estimate.start_s,
        "end_s": estimate.end_s,
        "joint": estimate.joint.type,
        "direction": estimate.direction,
        f"moved_{unit}": factor * float(estimate.thetas.max()),
        "axis_ci95_deg": float(np.degrees(estimate.axis_ci95_rad)),
        "origin_ci95_mm": 1e3 * estimate.origin_ci95_m,
        "part_odds": estimate.part_odds,
        WARNINGS: list_warnings(estimate.part_odds),
    }


def _recovered_motion(run: Run, folder: Path, progress: Progress) -> MotionEstimate:
    scene, parts = labelled_scan(run.folders)
    demonstration = motion_input(run, scene, parts.labels)
    refused = run.out / REFUSED_MOTION
    if run.project.motion_method == "paper":
        capture = aligned_capture_of(run)
        masks = part_masks(capture, capture.cameras[0], demonstration)
        return run_paper_motion(demonstration, masks, folder, progress, refused)
    return run_motion(demonstration, folder, progress, refused=refused)


def motion_input(run: Run, scene: Gaussians, labels: NDArray[np.uint8]) -> MotionInput:
    """The input of AOMotion: the first fixed camera's video, the log, and the scan in its parts.

    Args:
        run: Finished up to its alignment.
        scene: The scan, world frame.
        labels: Part label of every Gaussian.

    Raises:
        SyncError: The clock offset is unknown.
    """
    capture = aligned_capture_of(run)
    name = capture.cameras[0].name
    calibrated = load_calibrated_cameras(run.folders["alignment"])[name]
    clock = calibrated.require_clock()
    return MotionInput(
        video=read_demo_videos(capture)[name],
        camera=calibrated.camera,
        log=capture.joint_log,
        robot=robot_of(capture),
        scene=scene,
        labels=labels,
        clock_offset_s=clock.offset_s,
        clock_sd_s=clock.sd_s,
    )


def scanned_world(folders: Mapping[str, Path]) -> Gaussians:
    """The trained Gaussians in the world frame, from the folders of finished stages."""
    S_world_recon = load_alignment(folders["alignment"]).S_world_recon
    return load_gaussians(folders["gaussians"]).gaussians_recon.transformed(S_world_recon)


def labelled_scan(folders: Mapping[str, Path]) -> tuple[Gaussians, Parts]:
    """The trained Gaussians as the parts stage cut them, world frame, and their labels."""
    parts = load_parts(folders["parts"])
    return parts.cut.applied(scanned_world(folders)), parts


def scanned_object(run: Run) -> tuple[Array, Array]:
    """Points of the moving and the static part (N, 3), (M, 3) as scanned, world frame, [m]."""
    world, parts = labelled_scan(run.folders)
    return surface_points(world, parts.labels, MOVING), surface_points(world, parts.labels, STATIC)


def posture_of(capture: Capture) -> RobotPosture:
    """The robot as it stood during the scan."""
    return RobotPosture(
        robot=robot_of(capture), joints=capture.robot.scan_joints, gripper=capture.robot.scan_gripper
    )


def scanned_twin(world: Gaussians, parts: Parts, joint: Joint, posture: RobotPosture) -> Twin:
    """The scan bound to the bodies that carry it, in the scan's state.

    Args:
        world: Gaussians, world frame.
        parts: Of these Gaussians.
        joint: Of the moving part.
        posture: The robot during the scan.
    """
    static, moving = (surface_points(world, parts.labels, label) for label in (STATIC, MOVING))
    state = TwinState(
        joints=posture.joints,
        gripper=posture.gripper,
        theta=0.0,
        T_world_object=object_frame(static, joint, moving),
    )
    return bind(world, parts.labels, parts.robot_bodies, posture.robot, joint, state)


def twin(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Every Gaussian bound to the body that carries it, and everything fitted to scan and video."""
    capture = aligned_capture_of(run)
    posture, motion = posture_of(capture), load_motion(run.folders["motion"])
    robot = posture.robot
    scanned = scanned_twin(*labelled_scan(run.folders), motion.joint, posture)
    film = pose_demo_video(capture, demo_camera_world(run), motion, scanned, robot)
    bound = add_drawer_interior(scanned, robot, film)
    films = [*pose_scan_images(capture, scan_cameras_world(run), bound), film]
    result = refine_appearance(bound, robot, films, progress)
    save_twin(folder, result)
    save_robot(folder, capture.robot)
    return {
        "gaussians": len(result.gaussians),
        "moving": int(np.sum(result.moves)),
        "tray": len(bound.gaussians) - len(scanned.gaussians),
    }


def demo_camera_world(run: Run) -> Camera:
    """The first fixed camera, as estimated."""
    name = read_capture(run.project.capture).cameras[0].name
    return load_calibrated_cameras(run.folders["alignment"])[name].camera


def scan_cameras_world(run: Run) -> dict[str, Camera]:
    """Registered scan cameras by image name."""
    S_world_recon = load_alignment(run.folders["alignment"]).S_world_recon
    cameras = load_structure(run.folders["structure"]).cameras_recon
    return {name: camera_in_world(S_world_recon, camera) for name, camera in cameras.items()}


def demo_fps(run: Run) -> float:
    """Frame rate of the first demonstration video, [1/s]."""
    return float(round(probe_video(capture_of(run).cameras[0].video).fps))
