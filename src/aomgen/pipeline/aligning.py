"""The stage that brings scan, robot and fixed cameras together. [paper 4.1]"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.alignment.align import Alignment
from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.calibrated_cameras import save_calibrated_cameras
from aomgen.alignment.fixed_camera_calibration import AlignedScan, FixedCameraVideo, calibrate_fixed_cameras
from aomgen.alignment.stage import boxes_of, run_alignment, save_alignment, views_of
from aomgen.capture.capture_check import read_demo_videos
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress, part
from aomgen.core.recording import Capture
from aomgen.core.structure import Structure
from aomgen.gaussians.stage import load_gaussians
from aomgen.io.video import Video
from aomgen.paper.icp_alignment import align_as_paper
from aomgen.pipeline.stage import WARNINGS, Run
from aomgen.pipeline.twin_stages import posture_of
from aomgen.pipeline.working import capture_of
from aomgen.structure.stage import load_structure


def alignment(run: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Scale and pose of the scene in the robot's base frame; poses and clocks of the fixed cameras."""
    capture = capture_of(run)
    videos = read_demo_videos(capture)
    scene = load_structure(run.folders["structure"])
    paper = run.project.alignment_method == "paper"
    if paper:
        result = align_by_paper(capture, scene, load_gaussians(run.folders["gaussians"]).gaussians_recon)
    else:
        result = run_alignment(
            scene,
            {path.name: path for path in capture.scan_images},
            {name: video.frames_srgb[0] for name, video in videos.items()},
            capture.prompts,
            posture_of(capture),
            folder,
            part(progress, 0.0, 0.6),
        )
    calibration = calibrate_fixed_cameras(
        _start(capture, scene, result),
        _fixed_camera_videos(capture, scene, videos),
        part(progress, 0.6, 1.0),
        # The paper leaves fixed cameras where the scan has them.
        BundleParams(frames=0) if paper else None,
    )
    result = replace(
        result,
        S_world_recon=calibration.S_world_recon,
        joint_zeros_rad=calibration.zeros_rad,
        joint_zero_sds_rad=calibration.zero_sds_rad,
    )
    save_alignment(result, folder)
    save_calibrated_cameras(calibration.cameras, folder)
    return {
        "support": result.support,
        "runner_up_support": result.runner_up_support,
        "residual_px": result.residual_px,
        "end_effector_sd_mm": 1e3 * result.ee_sd_m,
        "largest_joint_zero_deg": float(np.degrees(np.abs(calibration.zeros_rad).max())),
        "fixed_cameras": {name: camera.summary() for name, camera in calibration.cameras.items()},
        WARNINGS: [warning for name, item in calibration.cameras.items() for warning in item.warnings(name)],
    }


def align_by_paper(capture: Capture, scene: Structure, gaussians_recon: Gaussians) -> Alignment:
    """The paper's alignment of a capture, see `align_as_paper`."""
    return align_as_paper(
        views_of(scene, {path.name: path for path in capture.scan_images}, {}),
        boxes_of(scene, capture.prompts, ("robot",)),
        gaussians_recon,
        posture_of(capture),
        np.random.default_rng(0),
    )


def _start(capture: Capture, scene: Structure, result: Alignment) -> AlignedScan:
    return AlignedScan(
        S_world_recon=result.S_world_recon,
        views=views_of(scene, {path.name: path for path in capture.scan_images}, {}),
        points_recon=scene.points_recon,
        posture=posture_of(capture),
        log=capture.joint_log,
        clock_offset_s=capture.clock_offset_s,
    )


def _fixed_camera_videos(
    capture: Capture, scene: Structure, videos: dict[str, Video]
) -> dict[str, FixedCameraVideo]:
    return {
        camera.name: FixedCameraVideo(
            video=videos[camera.name],
            camera_recon=scene.demo_cameras_recon[camera.name],
            T_world_cam=camera.T_world_cam,
        )
        for camera in capture.cameras
        if camera.name in scene.demo_cameras_recon
    }
