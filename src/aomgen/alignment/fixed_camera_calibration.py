"""The fixed cameras of the demonstration: poses and clocks, refined together with the alignment.

Each camera starts where structure from motion and the alignment put it; the silhouettes give a first
guess of its clock, and the moving arm refines all of it (`bundle_adjustment`). A camera that cannot be
refined keeps its pose; the reason is stored.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_adjustment import BundleSolution, drifts
from aomgen.alignment.bundle_equations import BundleParams, BundleProblem, CameraEvidence
from aomgen.alignment.calibration_check import deviation, refuse_gross
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.held_out_frames import HeldOutSplit, estimate_joint_zeros, reject_unconfirmed
from aomgen.alignment.scan_information import ScanViews
from aomgen.alignment.silhouette_fit import gray_levels, limit_width, robot_drawing, spread
from aomgen.alignment.silhouette_residuals import (
    LoggedRobot,
    choose_frames,
    empty_frames,
    read_gray_frames,
    trace,
)
from aomgen.alignment.time_offset import estimate_clock
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.fixed_camera import FixedCamera
from aomgen.core.joint_log import JointLog
from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze
from aomgen.errors import SyncError
from aomgen.io.video import Video
from aomgen.robots.configuration import RobotConfiguration
from aomgen.robots.robot_masks import robot_masks

# Scan views that carry the information of the alignment.
_VIEWS = 24
# Every second frame is held out of the refinement and validates it.
_HOLD_OUT_EVERY = 2
# Frames that must show the arm, of those chosen.
_MIN_FRAMES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCameraVideo:
    """One fixed camera of a capture.

    Attributes:
        video: Of the demonstration.
        camera_recon: As structure from motion placed it, recon frame, the video's size.
        T_world_cam: Hand-eye calibration (4, 4), or None.
    """

    video: Video
    camera_recon: Camera
    T_world_cam: Array | None = None

    def __post_init__(self) -> None:
        if self.T_world_cam is not None:
            freeze(self, "T_world_cam", self.T_world_cam, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedScan:
    """Initial values of the refinement.

    Attributes:
        S_world_recon: Aligned similarity (4, 4).
        views: Scan images that may be used.
        points_recon: Sparse points (P, 3) of the structure.
        configuration: Robot during the scan.
        log: Joint log of the demonstration.
        clock_offset_s: Log time minus video time when it is known.
    """

    S_world_recon: Array
    views: list[AlignmentImage]
    points_recon: Array
    configuration: RobotConfiguration
    log: JointLog
    clock_offset_s: float | None

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCameraCalibration:
    """Similarity, fixed cameras and joint zeros after the refinement; `zeros_rad` (J,) add to the log's joints."""

    S_world_recon: Array
    cameras: dict[str, FixedCamera]
    zeros_rad: Array
    zero_sds_rad: Array

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))
        freeze(self, "zeros_rad", self.zeros_rad, (None,))
        freeze(self, "zero_sds_rad", self.zero_sds_rad, (len(self.zeros_rad),))


def calibrate_fixed_cameras(
    scene: AlignedScan,
    videos: Mapping[str, FixedCameraVideo],
    progress: Progress,
    params: BundleParams | None = None,
) -> FixedCameraCalibration:
    """Pose and clock of every fixed camera, and the similarity that fits them.

    Args:
        scene: Alignment, scan and robot.
        videos: Fixed cameras by name.
        progress: Called after each step.
        params: Priors and effort.

    Raises:
        AlignmentError: A calibrated camera grossly contradicts the scan.

    A clock that is not determined, or that drifts, is kept as refused with its reason.
    """
    params = params or BundleParams()
    S = scene.S_world_recon
    for name, item in videos.items():
        if item.T_world_cam is not None:
            placed = camera_in_world(S, item.camera_recon)
            refuse_gross(name, item.T_world_cam, placed, scene.configuration.points_world(300))
    clocks: dict[str, Clock | SyncError] = {}
    for index, (name, item) in enumerate(videos.items()):
        clocks[name] = _first_clock(scene, item)
        progress(0.5 * (index + 1) / len(videos), f"clock of camera '{name}'")
    views = [limit_width(view, params.width) for view in scene.views]
    pictures = [view.camera_recon for view in views] + [_small(item, params) for item in videos.values()]
    width, height = (max(getattr(c, side) for c in pictures) for side in ("width", "height"))
    with robot_drawing(scene.configuration, width, height) as drawing:
        # Without frames cameras and scan stay where they are.
        shown = spread(views, S, drawing, _VIEWS) if params.frames else []
        zeros_rad = np.zeros(len(scene.configuration.joints))
        arm = LoggedRobot(
            robot=scene.configuration.robot, log=scene.log, renderer=drawing.fine, zeros_rad=zeros_rad
        )
        splits = {name: _split_frames(S, item, clocks[name], arm, params) for name, item in videos.items()}
        problem = BundleProblem(
            S_world_recon=S,
            scan=ScanViews(
                views=shown, grays=[gray_levels(view.image_srgb) for view in shown], drawing=drawing
            ),
            points_recon=scene.points_recon,
            arm=arm,
            cameras={name: _in_problem(videos[name], split, params) for name, split in splits.items()},
            params=params,
        )
        progress(0.6, "refining cameras and clocks")
        problem, refinement, splits = reject_unconfirmed(problem, splits)
        progress(0.8, "estimating joint zeros")
        refinement = estimate_joint_zeros(problem, splits, refinement)
    cameras = {
        name: _calibrated_camera(name, item, splits[name], refinement) for name, item in videos.items()
    }
    progress(1.0, "; ".join(f"camera '{name}': {item.note}" for name, item in cameras.items()))
    return FixedCameraCalibration(
        S_world_recon=refinement.S_world_recon,
        cameras=cameras,
        zeros_rad=refinement.zeros_rad,
        zero_sds_rad=refinement.zero_sds_rad,
    )


def _small(item: FixedCameraVideo, params: BundleParams) -> Camera:
    camera = item.camera_recon
    width = min(camera.width, params.width)
    return camera.resized(width, round(camera.height * width / camera.width))


def _first_clock(scene: AlignedScan, item: FixedCameraVideo) -> Clock | SyncError:
    times = item.video.times_s
    if scene.clock_offset_s is not None:
        return Clock(offset_s=scene.clock_offset_s, middle_s=float(times[0] + times[-1]) / 2)
    camera = camera_in_world(scene.S_world_recon, item.camera_recon)
    with robot_masks(scene.configuration.robot, camera, scene.log) as masks_at:
        try:
            return estimate_clock(item.video, scene.log.times_s, masks_at)
        except SyncError as error:
            return error


def _split_frames(
    S: Array, item: FixedCameraVideo, clock: Clock | SyncError, arm: LoggedRobot, params: BundleParams
) -> HeldOutSplit:
    """Frames to fit and frames to validate, if enough of them show the arm."""
    empty, calibrated = empty_frames(), item.T_world_cam is not None
    if isinstance(clock, SyncError):
        return HeldOutSplit(
            frames=empty, held_out=empty, clock=clock, reason=clock.problem, calibrated=calibrated
        )
    if not params.frames:
        return HeldOutSplit(frames=empty, held_out=empty, clock=clock, reason="", calibrated=calibrated)
    chosen = choose_frames(item.video, arm, clock, params.frames * _HOLD_OUT_EVERY // (_HOLD_OUT_EVERY - 1))
    validating = np.arange(len(chosen)) % _HOLD_OUT_EVERY == _HOLD_OUT_EVERY // 2
    frames, held_out = (
        read_gray_frames(item.video, chosen[part], params.width) for part in (~validating, validating)
    )
    camera = camera_in_world(S, _small(item, params))
    shown = len(trace(frames, camera, clock, arm, params.points))
    if shown >= _MIN_FRAMES:
        return HeldOutSplit(frames=frames, held_out=held_out, clock=clock, reason="", calibrated=calibrated)
    reason = f"{shown} of {len(frames.times_s)} frames show the arm, want {_MIN_FRAMES}"
    return HeldOutSplit(frames=empty, held_out=empty, clock=clock, reason=reason, calibrated=calibrated)


def _in_problem(item: FixedCameraVideo, split: HeldOutSplit, params: BundleParams) -> CameraEvidence:
    return CameraEvidence(
        camera_recon=_small(item, params),
        frames=split.frames,
        clock=split.clock
        if isinstance(split.clock, Clock) and len(split.frames.times_s)
        else Clock(offset_s=0.0),
        T_world_cam=item.T_world_cam if split.calibrated else None,
    )


def _calibrated_camera(
    name: str, item: FixedCameraVideo, split: HeldOutSplit, refinement: BundleSolution
) -> FixedCamera:
    state = refinement.cameras[name]
    used = bool(len(split.frames.times_s))
    start = camera_in_world(refinement.S_world_recon, item.camera_recon)
    known = used or split.calibrated
    camera = item.camera_recon.moved(state.camera.T_world_cam) if known else start
    moved = deviation(start.T_world_cam, camera)
    figures = {"moved_mm": 1e3 * moved.distance_m, "moved_deg": float(np.degrees(moved.angle_rad))}
    note = "refined on the moving arm" if used else "as the scan placed it"
    note += f": {split.reason}" if split.reason else ""
    if item.T_world_cam is not None:
        apart = deviation(item.T_world_cam, camera)
        figures |= {"calibration_mm": 1e3 * apart.distance_m}
        figures |= {"calibration_deg": float(np.degrees(apart.angle_rad))}
        verdict = "agrees" if split.calibrated else "contradicts the evidence and is not used"
        note += f"; its calibration {verdict} ({apart})"
    clock = state.clock if used else split.clock
    refusal: tuple[str, ...] = ()
    if isinstance(clock, SyncError):
        refusal = (clock.where, clock.problem, clock.remedy)
    elif drifts(clock, float(item.video.times_s[-1] - item.video.times_s[0])):
        refusal = _drift_refusal(name, clock, item.video)
    else:
        clock = replace(clock, rate=0.0)
    return FixedCamera(
        camera=camera,
        clock=clock if isinstance(clock, Clock) and not refusal else None,
        refusal=refusal,
        note=note,
        trusted=not split.reason and split.calibrated == (item.T_world_cam is not None),
        figures=figures,
    )


def _drift_refusal(name: str, clock: Clock, video: Video) -> tuple[str, ...]:
    length = float(video.times_s[-1] - video.times_s[0])
    return (
        f"clock of camera '{name}'",
        f"the joint log counts {1 + clock.rate:.4f} s (+-{clock.rate_sd:.4f}) while the video counts 1 s, "
        f"{abs(clock.rate) * length:.2f} s over the demonstration",
        f"export the video with its true frame times, or multiply time_s of the log by {1 / (1 + clock.rate):.4f}",
    )
