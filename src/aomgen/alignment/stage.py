"""The similarity that brings scan and robot together; poses and clocks of the fixed cameras. [paper 4.1]"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.align import AlignmentParams, align
from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.fixed_camera_calibration import AlignedScan, FixedCameraVideo, calibrate_fixed_cameras
from aomgen.alignment.pose_search import Scan
from aomgen.alignment.starting_poses import RobotBox
from aomgen.alignment.uncertainty import CameraErrors, camera_covariance
from aomgen.core.alignment import Alignment
from aomgen.core.progress import Progress, part
from aomgen.core.recording import Prompt, Recording
from aomgen.core.structure import Structure, held_out
from aomgen.io.artifact import save_artifact
from aomgen.io.images import read_image
from aomgen.results import Results

# Seed of the plane search, fixed so that a run can be repeated.
SEED = 0
# Largest differences of equal configurations: more than the noise of encoders, less than a visible motion. Joints are in rad or m,
# the gripper is a share of its stroke.
SAME_JOINTS, SAME_GRIPPER = 0.01, 0.05


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Align the scan with the robot, then calibrate the fixed cameras."""
    found = align_scan(results, part(progress, 0.0, 0.6))
    return calibrate_cameras(results, found, folder, part(progress, 0.6, 1.0))


def align_scan(results: Results, progress: Progress, boxes: Sequence[RobotBox] = ()) -> Alignment:
    """Estimate the similarity from the robot's contours; held-out images are not used.

    The first frames of the fixed cameras are used if the robot begins the demonstration in its configuration of the scan.

    Args:
        boxes: Boxes around the robot, in addition to those of the prompts.
    """
    capture, structure = results.pinhole_capture, results.structure
    videos = results.videos if starts_as_scanned(capture) else {}
    first_srgb = {name: video.frames_srgb[0] for name, video in videos.items()}
    scan = Scan(
        views=views_of(structure, results.scan_images, first_srgb),
        boxes=[*boxes, *boxes_of(structure, capture.prompts, ("robot",))],
        points_recon=structure.points_recon,
        errors=camera_errors_of(structure),
    )
    params = results.params("alignment", AlignmentParams())
    return align(scan, results.configuration_in(capture), progress, np.random.default_rng(SEED), params)


def starts_as_scanned(capture: Recording) -> bool:
    """Return whether the robot begins the demonstration in its configuration of the scan.

    If the clock offset is unknown, the videos are assumed to begin with the log.
    """
    log, robot = capture.joint_log, capture.robot
    start_s = log.times_s[0] if capture.clock_offset_s is None else capture.clock_offset_s
    joints, gripper = log.at(start_s)
    joints_equal = np.abs(joints - robot.scan_joints).max() <= SAME_JOINTS
    return bool(joints_equal and abs(gripper - robot.scan_gripper) <= SAME_GRIPPER)


def calibrate_cameras(
    results: Results,
    found: Alignment,
    folder: Path,
    progress: Progress,
    params: BundleParams | None = None,
) -> dict[str, Any]:
    """Calibrate the fixed cameras, refine the similarity with them, and write both."""
    capture, structure = results.pinhole_capture, results.structure
    scan = AlignedScan(
        alignment=found,
        views=views_of(structure, results.scan_images, {}),
        points_recon=structure.points_recon,
        configuration=results.configuration_in(capture),
        log=capture.joint_log,
    )
    videos = {
        camera.name: FixedCameraVideo(
            video=results.videos[camera.name],
            camera_recon=structure.demo_cameras_recon[camera.name],
            T_world_cam=camera.T_world_cam,
            clock_offset_s=capture.clock_offset_s if camera is capture.cameras[0] else None,
        )
        for camera in capture.cameras
        if camera.name in structure.demo_cameras_recon
    }
    result = calibrate_fixed_cameras(scan, videos, progress, params)
    save_artifact(folder, "alignment", result)
    revolute_zeros_rad = result.joint_zeros_rad[~results.robot.slides]
    return {
        "support": result.support,
        "runner_up_support": result.runner_up_support,
        "residual_px": result.residual_px,
        "end_effector_sd_mm": 1e3 * result.ee_sd_m,
        "largest_joint_zero_deg": float(np.degrees(np.abs(revolute_zeros_rad).max(initial=0.0))),
        "fixed_cameras": {name: camera.summary() for name, camera in result.cameras.items()},
        "warnings": [warning for name, item in result.cameras.items() for warning in item.warnings(name)],
    }


def camera_errors_of(structure: Structure) -> CameraErrors:
    """Compute the covariance of the scan cameras from the structure's observations, recon frame."""
    return CameraErrors(
        names=tuple(structure.cameras_recon),
        covariance=camera_covariance(
            list(structure.cameras_recon.values()),
            structure.points_recon,
            structure.observations,
            structure.reprojection_error_px,
        ),
    )


def views_of(
    structure: Structure, images: Mapping[str, Path], demo_first_srgb: Mapping[str, NDArray[np.uint8]]
) -> list[AlignmentImage]:
    """Scan images that are not held out, and the first frames of the fixed cameras."""
    withheld = set(held_out(list(images)))
    views = [
        AlignmentImage(name=name, camera_recon=camera, image_srgb=read_image(images[name]))
        for name, camera in structure.cameras_recon.items()
        if name not in withheld
    ]
    return views + [
        AlignmentImage(name=name, camera_recon=structure.demo_cameras_recon[name], image_srgb=image)
        for name, image in demo_first_srgb.items()
        if name in structure.demo_cameras_recon
    ]


def boxes_of(structure: Structure, prompts: tuple[Prompt, ...], parts: tuple[str, ...]) -> list[RobotBox]:
    """List the prompted boxes of some parts, on images that have a camera."""
    return [
        RobotBox(camera_recon=structure.cameras_recon[prompt.image], box_px=prompt.box)
        for prompt in prompts
        if prompt.part in parts and len(prompt.box) == 4 and prompt.image in structure.cameras_recon
    ]
