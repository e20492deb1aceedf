"""The fixed cameras of the demonstration: poses and clocks, refined together with the alignment.

The initial pose of each camera is that of structure from motion and the alignment, and the silhouettes give an initial estimate
of its clock. Both are refined with the contours of the moving arm (`bundle_adjustment`). A camera that cannot be refined keeps
its pose; the reason is stored.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.arm_contours import NO_FRAMES, LoggedRobot, choose_frames, read_gray_frames, trace
from aomgen.alignment.bundle_adjustment import adjust_validated, drifts
from aomgen.alignment.bundle_terms import (
    BundleParams,
    BundleProblem,
    BundleSolution,
    CameraEvidence,
    pose_difference,
)
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.silhouette_fit import limit_width, robot_drawing, spread
from aomgen.alignment.time_offset import estimate_clock
from aomgen.core.alignment import Alignment, Clock, FixedCamera
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.progress import Progress
from aomgen.core.recording import JointLog
from aomgen.core.transforms import invert
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.errors import AlignmentError, SyncError
from aomgen.io.video import Video
from aomgen.robots.robot import RobotConfiguration
from aomgen.robots.silhouette import robot_masks

# Number of scan views that represent the information of the alignment.
_VIEWS = 24
# Least number of chosen frames that show the arm.
_MIN_FRAMES = 8
# Largest displacement of the robot in the image by a calibration, as a share of the width. Calibrations and alignments are accurate
# to millimeters, so a larger displacement means a wrong calibration, not an inaccurate one.
_GROSS_SHARE = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCameraVideo:
    """One fixed camera of a capture.

    Attributes:
        camera_recon: Camera as estimated by structure from motion, recon frame, at the size of the video.
        T_world_cam: Hand-eye calibration (4, 4), or None.
        clock_offset_s: Log time minus video time, [s]; None if it is unknown.
    """

    video: Video
    camera_recon: Camera
    T_world_cam: Matrix4 | None = None
    clock_offset_s: float | None = None

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedScan:
    """Initial values of the refinement.

    Attributes:
        views: Scan images that may be used.
        configuration: Robot during the scan.
    """

    alignment: Alignment
    views: list[AlignmentImage]
    points_recon: Array
    configuration: RobotConfiguration
    log: JointLog


def calibrate_fixed_cameras(
    scene: AlignedScan,
    videos: Mapping[str, FixedCameraVideo],
    progress: Progress,
    params: BundleParams | None = None,
) -> Alignment:
    """Estimate the pose and clock of every fixed camera, the joint zeros, and the similarity that is consistent with them.

    Raises:
        AlignmentError: A calibrated camera grossly contradicts the scan.

    A clock that cannot be determined, or that drifts, is stored as rejected with the reason.
    """
    params = params or BundleParams()
    S = scene.alignment.S_world_recon
    clocks: dict[str, Clock | SyncError] = {}
    for index, (name, item) in enumerate(videos.items()):
        if item.T_world_cam is not None:
            placed = camera_in_world(S, item.camera_recon)
            refuse_gross(name, item.T_world_cam, placed, scene.configuration.points_world(300))
        progress(0.5 * index / len(videos), f"looking for the clock of camera '{name}'")
        clocks[name] = _first_clock(scene, item)
    views = [limit_width(view, params.width) for view in scene.views]
    sizes = [view.camera_recon for view in views] + [
        item.camera_recon.narrow(params.width) for item in videos.values()
    ]
    width, height = max(camera.width for camera in sizes), max(camera.height for camera in sizes)
    with robot_drawing(scene.configuration, width, height) as drawing:
        arm = LoggedRobot(
            robot=scene.configuration.robot,
            log=scene.log,
            renderer=drawing.fine,
            zeros_rad=np.zeros(len(scene.configuration.joints)),
        )
        problem = BundleProblem(
            S_world_recon=S,
            # Without frames, cameras and scan keep their poses.
            views=spread(views, S, drawing, _VIEWS) if params.frames else [],
            drawing=drawing,
            points_recon=scene.points_recon,
            arm=arm,
            cameras={name: _evidence(S, item, clocks[name], arm, params) for name, item in videos.items()},
            params=params,
        )
        progress(0.6, "refining cameras and clocks")
        problem, found = adjust_validated(problem)
    cameras = {
        name: _make_fixed_camera(name, item, problem.cameras[name], clocks[name], found)
        for name, item in videos.items()
    }
    progress(1.0, "; ".join(f"camera '{name}': {item.note}" for name, item in cameras.items()))
    return replace(
        scene.alignment,
        S_world_recon=found.S_world_recon,
        cameras=cameras,
        joint_zeros_rad=found.zeros_rad,
        joint_zero_sds_rad=found.zero_sds_rad,
    )


def _first_clock(scene: AlignedScan, item: FixedCameraVideo) -> Clock | SyncError:
    times = item.video.times_s
    if item.clock_offset_s is not None:
        return Clock(offset_s=item.clock_offset_s, middle_s=float(times[0] + times[-1]) / 2)
    camera = camera_in_world(scene.alignment.S_world_recon, item.camera_recon)
    with robot_masks(scene.configuration.robot, camera, scene.log) as masks_at:
        try:
            return estimate_clock(item.video, scene.log.times_s, masks_at)
        except SyncError as error:
            return error


def _evidence(
    S: Array, item: FixedCameraVideo, clock: Clock | SyncError, arm: LoggedRobot, params: BundleParams
) -> CameraEvidence:
    """Select frames of a camera for the fit and for its validation, if enough of them show the arm."""
    small = item.camera_recon.narrow(params.width)
    unused = CameraEvidence(
        camera_recon=small,
        frames=NO_FRAMES,
        held_out=NO_FRAMES,
        clock=Clock(offset_s=0.0),
        T_world_cam=item.T_world_cam,
    )
    if isinstance(clock, SyncError):
        return replace(unused, rejected=clock.problem)
    if not params.frames:
        return unused
    # Every second frame is held out of the refinement and validates it.
    chosen = choose_frames(item.video, arm, clock, 2 * params.frames)
    frames, held_out = (
        read_gray_frames(item.video, part, params.width) for part in (chosen[::2], chosen[1::2])
    )
    shown = len(trace(frames, camera_in_world(S, small), clock, arm, params.points))
    if shown >= _MIN_FRAMES:
        return replace(unused, frames=frames, held_out=held_out, clock=clock)
    reason = f"{shown} of {len(frames.times_s)} frames show the arm, expected {_MIN_FRAMES}"
    return replace(unused, rejected=reason)


def _make_fixed_camera(
    name: str,
    item: FixedCameraVideo,
    evidence: CameraEvidence,
    clock: Clock | SyncError,
    found: BundleSolution,
) -> FixedCamera:
    used, calibrated = bool(len(evidence.frames.times_s)), evidence.T_world_cam is not None
    state = found.cameras[name]
    camera = start = camera_in_world(found.S_world_recon, item.camera_recon)
    if used or calibrated:
        camera = item.camera_recon.move(state.camera.T_world_cam)
    moved_mm, moved_deg = _apart(camera, start.T_world_cam)
    figures = {"moved_mm": moved_mm, "moved_deg": moved_deg}
    note = "refined on the moving arm" if used else "as the scan placed it"
    note += f": {evidence.rejected}" if evidence.rejected else ""
    if item.T_world_cam is not None:
        apart_mm, apart_deg = _apart(camera, item.T_world_cam)
        figures |= {"calibration_mm": apart_mm, "calibration_deg": apart_deg}
        verdict = "agrees" if calibrated else "contradicts the evidence and is not used"
        note += f"; its calibration {verdict} ({apart_mm:.1f} mm, {apart_deg:.2f} deg)"
    clock = state.clock if used else clock
    refusal: tuple[str, ...] = ()
    if isinstance(clock, SyncError):
        refusal = (clock.where, clock.problem, clock.remedy)
    elif drifts(clock, float(item.video.times_s[-1] - item.video.times_s[0])):
        refusal = _drift_refusal(name, clock, item.video)
    return FixedCamera(
        camera=camera,
        clock=replace(clock, rate=0.0) if isinstance(clock, Clock) and not refusal else None,
        refusal=refusal,
        note=note,
        trusted=not evidence.rejected and calibrated == (item.T_world_cam is not None),
        figures=figures,
    )


def _apart(camera: Camera, T_world_cam: Array) -> tuple[float, float]:
    """Compute the distance [mm] and the angle [deg] between a camera and a pose."""
    turn, move = np.split(pose_difference(camera, T_world_cam), 2)
    return 1e3 * float(np.linalg.norm(move)), float(np.degrees(np.linalg.norm(turn)))


def _drift_refusal(name: str, clock: Clock, video: Video) -> tuple[str, ...]:
    length = float(video.times_s[-1] - video.times_s[0])
    return (
        f"clock of camera '{name}'",
        f"the joint log counts {1 + clock.rate:.4f} s (+-{clock.rate_sd:.4f}) while the video counts 1 s, "
        f"{abs(clock.rate) * length:.2f} s over the demonstration",
        f"export the video with its true frame times, or multiply time_s of the log by {1 / (1 + clock.rate):.4f}",
    )


def refuse_gross(name: str, T_world_cam: Array, camera: Camera, robot_world: Array) -> None:
    """Refuse a calibration that displaces the robot in the image relative to the scan's camera.

    Args:
        T_world_cam: Calibration of capture.toml (4, 4).
        camera: Camera as estimated from scan and alignment, world frame.
        robot_world: Points on the robot (N, 3), [m].

    Raises:
        AlignmentError: States the distance of the poses, and the common mistake that explains it, if there is one.
    """

    def shift_share(T: Array) -> float:
        """Compute the median shift of the robot in the image as a share of its width; infinite if it is behind the camera."""
        there, depths = camera.move(T).project(robot_world)
        shifts = np.linalg.norm(there - camera.project(robot_world)[0], axis=1)
        return float(np.median(shifts)) / camera.width if np.median(depths) > 0 else float("inf")

    share = shift_share(T_world_cam)
    if share <= _GROSS_SHARE:
        return
    mistakes = {
        "it looks like T_cam_world; write its inverse": invert(T_world_cam),
        "it seems to use the robot's other base frame; correct robot.base_frame": np.diag([-1.0, -1, 1, 1])
        @ T_world_cam,
        "it seems to use OpenGL axes; convert it to x right, y down, z forward": T_world_cam
        @ np.diag([1.0, -1, -1, 1]),
    }
    # A known mistake explains a calibration if its correction removes three quarters of the shift.
    explained = [remedy for remedy, T in mistakes.items() if shift_share(T) <= 0.25 * min(share, 1.0)]
    apart_mm, apart_deg = _apart(camera, T_world_cam)
    raise AlignmentError(
        f"demo camera '{name}'",
        f"T_world_cam in capture.toml is {apart_mm:.1f} mm, {apart_deg:.2f} deg from the pose "
        f"that scan and robot determine, and displaces the robot by {share:.0%} of the image width "
        f"(limit {_GROSS_SHARE:.0%})",
        [*explained, "calibrate again, or leave T_world_cam out"][0],
    )
