"""The fixed cameras of the demonstration: poses and clocks, refined together with the alignment.

Each camera starts where structure from motion and the alignment put it; the silhouettes give a first
guess of its clock, and the moving arm refines all of it (`joint_refinement`). What cannot be refined
keeps its place, with the reason.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.bundle_adjustment import Refinement, drifts
from aomgen.alignment.bundle_equations import FilmedCamera, JointParams, JointProblem
from aomgen.alignment.calibrated_cameras import SettledCamera
from aomgen.alignment.calibration_check import deviation, refuse_gross
from aomgen.alignment.contours import View
from aomgen.alignment.held_out_frames import Take, judge, take_zeros
from aomgen.alignment.scan_information import Scanned
from aomgen.alignment.silhouette_fit import gray_levels, reduced, robot_drawing, spread
from aomgen.alignment.silhouette_residuals import (
    Arm,
    film_of,
    no_film,
    spread_frames,
    trace,
)
from aomgen.alignment.time_offset import estimate_clock
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.clock import Clock
from aomgen.core.joint_log import JointLog
from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze
from aomgen.errors import SyncError
from aomgen.io.video import Video
from aomgen.robots.configuration import RobotPosture
from aomgen.robots.robot_masks import robot_masks

# Scan views that say how well the alignment is known.
_VIEWS = 24
# Every other frame is left out of the refinement and judges it.
_JUDGE_EVERY = 2
# Frames that must show the arm, of those chosen.
_MIN_FRAMES = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Filmed:
    """What a capture holds of one fixed camera.

    Attributes:
        video: Its film of the demonstration.
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
class Scene:
    """What the refinement starts from.

    Attributes:
        S_world_recon: The alignment's answer (4, 4).
        views: Scan images it may look at.
        points_recon: Sparse points (P, 3) of the structure.
        posture: Robot during the scan.
        log: Joint log of the demonstration.
        clock_offset_s: Log time minus video time when it is known.
    """

    S_world_recon: Array
    views: list[View]
    points_recon: Array
    posture: RobotPosture
    log: JointLog
    clock_offset_s: float | None

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Settlement:
    """Similarity, fixed cameras and joint zeros after the refinement; `zeros_rad` (J,) add to the log's joints."""

    S_world_recon: Array
    cameras: dict[str, SettledCamera]
    zeros_rad: Array
    zero_sds_rad: Array

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))
        freeze(self, "zeros_rad", self.zeros_rad, (None,))
        freeze(self, "zero_sds_rad", self.zero_sds_rad, (len(self.zeros_rad),))


def settle_fixed_cameras(
    scene: Scene, filmed: Mapping[str, Filmed], progress: Progress, params: JointParams | None = None
) -> Settlement:
    """Pose and clock of every fixed camera, and the similarity that fits them.

    Args:
        scene: Alignment, scan and robot.
        filmed: Fixed cameras by name.
        progress: Told after each step.
        params: Beliefs and effort.

    Raises:
        AlignmentError: A calibrated camera grossly contradicts the scan.

    A clock that is not determined, or that drifts, is kept as refused with its reason.
    """
    params = params or JointParams()
    S = scene.S_world_recon
    for name, item in filmed.items():
        if item.T_world_cam is not None:
            placed = camera_in_world(S, item.camera_recon)
            refuse_gross(name, item.T_world_cam, placed, scene.posture.points_world(300))
    clocks: dict[str, Clock | SyncError] = {}
    for index, (name, item) in enumerate(filmed.items()):
        clocks[name] = _first_clock(scene, item)
        progress(0.5 * (index + 1) / len(filmed), f"clock of camera '{name}'")
    views = [reduced(view, params.width) for view in scene.views]
    pictures = [view.camera_recon for view in views] + [_small(item, params) for item in filmed.values()]
    width, height = (max(getattr(c, side) for c in pictures) for side in ("width", "height"))
    with robot_drawing(scene.posture, width, height) as drawing:
        # Without frames cameras and scan stay where they are.
        shown = spread(views, S, drawing, _VIEWS) if params.frames else []
        zeros_rad = np.zeros(len(scene.posture.joints))
        arm = Arm(robot=scene.posture.robot, log=scene.log, renderer=drawing.fine, zeros_rad=zeros_rad)
        takes = {name: _take(S, item, clocks[name], arm, params) for name, item in filmed.items()}
        problem = JointProblem(
            S_world_recon=S,
            scan=Scanned(
                views=shown, grays=[gray_levels(view.image_srgb) for view in shown], drawing=drawing
            ),
            points_recon=scene.points_recon,
            arm=arm,
            cameras={name: _in_problem(filmed[name], take, params) for name, take in takes.items()},
            params=params,
        )
        progress(0.6, "refining cameras and clocks")
        problem, refinement, takes = judge(problem, takes)
        progress(0.8, "estimating joint zeros")
        refinement = take_zeros(problem, takes, refinement)
    cameras = {name: _settled(name, item, takes[name], refinement, params) for name, item in filmed.items()}
    progress(1.0, "; ".join(f"camera '{name}': {item.note}" for name, item in cameras.items()))
    return Settlement(
        S_world_recon=refinement.S_world_recon,
        cameras=cameras,
        zeros_rad=refinement.zeros_rad,
        zero_sds_rad=refinement.zero_sds_rad,
    )


def _small(item: Filmed, params: JointParams) -> Camera:
    camera = item.camera_recon
    width = min(camera.width, params.width)
    return camera.resized(width, round(camera.height * width / camera.width))


def _first_clock(scene: Scene, item: Filmed) -> Clock | SyncError:
    times = item.video.times_s
    if scene.clock_offset_s is not None:
        return Clock(offset_s=scene.clock_offset_s, middle_s=float(times[0] + times[-1]) / 2)
    camera = camera_in_world(scene.S_world_recon, item.camera_recon)
    with robot_masks(scene.posture.robot, camera, scene.log) as masks_at:
        try:
            return estimate_clock(item.video, scene.log.times_s, masks_at)
        except SyncError as error:
            return error


def _take(S: Array, item: Filmed, clock: Clock | SyncError, arm: Arm, params: JointParams) -> Take:
    """Frames to learn from and to judge by, if enough of them show the arm."""
    empty, calibrated = no_film(), item.T_world_cam is not None
    if isinstance(clock, SyncError):
        return Take(film=empty, judges=empty, clock=clock, reason=clock.problem, calibrated=calibrated)
    if not params.frames:
        return Take(film=empty, judges=empty, clock=clock, reason="", calibrated=calibrated)
    frames = spread_frames(item.video, arm, clock, params.frames * _JUDGE_EVERY // (_JUDGE_EVERY - 1))
    judging = np.arange(len(frames)) % _JUDGE_EVERY == _JUDGE_EVERY // 2
    film, judges = (film_of(item.video, frames[chosen], params.width) for chosen in (~judging, judging))
    camera = camera_in_world(S, _small(item, params))
    shown = len(trace(film, camera, clock, arm, params.points))
    if shown >= _MIN_FRAMES:
        return Take(film=film, judges=judges, clock=clock, reason="", calibrated=calibrated)
    reason = f"{shown} of {len(film.times_s)} frames show the arm, want {_MIN_FRAMES}"
    return Take(film=empty, judges=empty, clock=clock, reason=reason, calibrated=calibrated)


def _in_problem(item: Filmed, take: Take, params: JointParams) -> FilmedCamera:
    return FilmedCamera(
        camera_recon=_small(item, params),
        film=take.film,
        clock=take.clock if isinstance(take.clock, Clock) and len(take.film.times_s) else Clock(offset_s=0.0),
        T_world_cam=item.T_world_cam if take.calibrated else None,
    )


def _settled(
    name: str, item: Filmed, take: Take, refinement: Refinement, params: JointParams
) -> SettledCamera:
    state = refinement.cameras[name]
    used = bool(len(take.film.times_s))
    start = camera_in_world(refinement.S_world_recon, item.camera_recon)
    known = used or take.calibrated
    camera = item.camera_recon.moved(state.camera.T_world_cam) if known else start
    moved = deviation(start.T_world_cam, camera)
    figures = {"moved_mm": 1e3 * moved.distance_m, "moved_deg": float(np.degrees(moved.angle_rad))}
    note = "refined on the moving arm" if used else "as the scan placed it"
    note += f": {take.reason}" if take.reason else ""
    if item.T_world_cam is not None:
        apart = deviation(item.T_world_cam, camera)
        figures |= {"calibration_mm": 1e3 * apart.distance_m}
        figures |= {"calibration_deg": float(np.degrees(apart.angle_rad))}
        verdict = "agrees" if take.calibrated else "contradicts the evidence and is not used"
        note += f"; its calibration {verdict} ({apart})"
    clock = state.clock if used else take.clock
    refusal: tuple[str, ...] = ()
    if isinstance(clock, SyncError):
        refusal = (clock.where, clock.problem, clock.remedy)
    elif drifts(clock, float(item.video.times_s[-1] - item.video.times_s[0]), params):
        refusal = _drift_refusal(name, clock, item.video)
    else:
        clock = replace(clock, rate=0.0)
    return SettledCamera(
        camera=camera,
        clock=clock if isinstance(clock, Clock) and not refusal else None,
        refusal=refusal,
        note=note,
        trusted=not take.reason and take.calibrated == (item.T_world_cam is not None),
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
