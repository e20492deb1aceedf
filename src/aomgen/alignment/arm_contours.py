"""Contours of the arm in scan views and in the frames of fixed cameras, rendered once and then extrapolated.

A contour rendered from the joint log differs from the observed one when the camera pose is wrong, when
the clock offset is wrong, or when images show every contour a little too wide or too narrow (blur, tone
curve, simplified meshes). The three can be separated because the arm moves along many directions: a
clock error scales with the velocity of the arm, a contour bias depends on neither pose nor velocity.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import AlignmentImage, Contour, edge_sds, edge_shifts
from aomgen.alignment.silhouette_fit import EDGE_KERNEL, RobotDrawing, render_robot
from aomgen.conventions import luma_from_srgb
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.least_squares import Kernel
from aomgen.core.recording import JointLog
from aomgen.core.transforms import invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.io.images import resize
from aomgen.io.video import Video
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer

# Time before and after a reading over which readings are averaged, to reduce encoder noise, [s].
_READING_S = 0.02
# Half of the interval of the finite differences of velocities, [s]: twice the averaging time, to reduce encoder noise.
_SPEED_S = 0.05
# Numbers of contour points of a scan view and of a validation frame; errors of closer points are correlated.
_SCAN_POINTS, _CHECK_POINTS = 400, 300
# Search range of the misfit in a validation frame, [px].
_CHECK_REACH_PX = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class GrayFrames:
    """Chosen frames of a video: video times (F,) and gray levels (F, H, W), 0..1."""

    times_s: Annotated[Array, "T"]
    grays: Annotated[NDArray[np.float32], "T H W"]

    __post_init__ = freeze_arrays


NO_FRAMES = GrayFrames(times_s=np.zeros(0), grays=np.zeros((0, 1, 1), np.float32))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedRobot:
    """The robot, its joint log, the joint zeros (J,) that are added to it [rad], and its renderer."""

    robot: RobotModel
    log: JointLog
    renderer: SilhouetteRenderer
    zeros_rad: Annotated[Array, "J"]

    __post_init__ = freeze_arrays

    def states(self, log_times_s: Array) -> tuple[Array, Array]:
        """Interpolate joints (T, J) and gripper (T,) at log times (T,), averaged over encoder noise."""
        offsets = np.linspace(-_READING_S, _READING_S, 5)
        readings = [self.log.at(log_times_s + offset) for offset in offsets]
        return np.mean([q for q, _ in readings], 0) + self.zeros_rad, np.mean([g for _, g in readings], 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmContour:
    """Contour of the arm as rendered for one image, and the motion of its C points with J joints and time.

    Attributes:
        index: Index of the frame or of the scan view.
        gray: Gray levels (H, W) of the image.
        contour: World frame.
        turns: (C, J, 3), [m/rad].
        velocities: (C, 3), per second of the log; 0 in the scan, [m/s].
        zeros_rad, log_time_s: Joint zeros (J,) and log time of the rendering.
    """

    index: int
    gray: NDArray[np.float32]
    contour: Contour
    turns: Array
    velocities: Array
    zeros_rad: Array
    log_time_s: float = 0.0

    def at(self, camera: Camera, zeros_rad: Array, log_time_s: float = 0.0) -> Contour:
        """Extrapolate the contour to a nearby camera pose, joint zeros and log time, to first order."""
        turned = np.einsum("j,cjd->cd", zeros_rad - self.zeros_rad, self.turns)
        points = self.contour.points + (log_time_s - self.log_time_s) * self.velocities + turned
        return self.contour.move(points, camera)


def read_gray_frames(video: Video, frames: NDArray[np.int64], width: int) -> GrayFrames:
    """Convert some frames to gray levels, at most `width` wide."""
    if not len(frames):
        return NO_FRAMES
    full = video.frames_srgb.shape[2]
    size = (min(full, width), round(video.frames_srgb.shape[1] * min(1.0, width / full)))
    grays = [luma_from_srgb(resize(video.frames_srgb[k], *size)) for k in frames]
    return GrayFrames(times_s=video.times_s[frames], grays=np.stack(grays))


def choose_frames(video: Video, arm: LoggedRobot, clock: Clock, count: int) -> NDArray[np.int64]:
    """Choose at most `count` frames that the log covers, evenly along the end effector's path."""
    covered = np.flatnonzero(arm.log.covers(clock.log_times(video.times_s)))
    if not len(covered):
        return covered
    places = arm.robot.ee_poses(arm.states(clock.log_times(video.times_s[covered]))[0])[:, :3, 3]
    # A small constant separates the frames of an arm at rest by time alone.
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) + 1e-4
    path = np.concatenate([[0.0], np.cumsum(steps)])
    marks = (np.arange(count) + 0.5) / count * path[-1]
    return covered[np.unique(np.searchsorted(path, marks))]


def trace(
    frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot, points: int
) -> list[ArmContour]:
    """Render contours for the frames that show enough of the arm, each with at most `points` points."""
    if not len(frames.times_s):
        return []
    times = clock.log_times(frames.times_s)
    joints, gripper = arm.states(times)
    before, after = (arm.robot.link_poses(*arm.states(times + step)) for step in (-_SPEED_S, _SPEED_S))
    motions = (after - before) @ invert(arm.robot.link_poses(joints, gripper)) / (2 * _SPEED_S)
    contours = []
    for k in range(len(times)):
        configuration = RobotConfiguration(robot=arm.robot, joints=joints[k], gripper=float(gripper[k]))
        drawn = render_robot(arm.renderer, configuration, camera, points)
        if drawn is None:
            continue
        contour, _, bodies = drawn
        own, moves = contour.points, motions[k][bodies]
        contours.append(
            ArmContour(
                index=k,
                gray=frames.grays[k],
                contour=contour,
                turns=configuration.turns(own, bodies),
                velocities=np.einsum("cij,cj->ci", moves[:, :3, :3], own) + moves[:, :3, 3],
                zeros_rad=arm.zeros_rad,
                log_time_s=float(times[k]),
            )
        )
    return contours


def trace_scan(
    views: list[AlignmentImage],
    grays: list[NDArray[np.float32]],
    drawing: RobotDrawing,
    S_world_recon: Array,
    zeros_rad: Array,
) -> list[ArmContour]:
    """Render contours of the scanned robot, with joint zeros, in the views that show enough of it; `grays` are theirs."""
    configuration = replace(drawing.configuration, joints=drawing.configuration.joints + zeros_rad)
    contours = []
    for index, view in enumerate(views):
        camera = camera_in_world(S_world_recon, view.camera_recon)
        drawn = render_robot(drawing.fine, configuration, camera, _SCAN_POINTS)
        if drawn is not None:
            contour, _, bodies = drawn
            contours.append(
                ArmContour(
                    index=index,
                    gray=grays[index],
                    contour=contour,
                    turns=configuration.turns(contour.points, bodies),
                    velocities=np.zeros_like(contour.points),
                    zeros_rad=zeros_rad,
                )
            )
    return contours


def common_bias(shifts: Array, sds: Array, kernel: Kernel) -> float:
    """Estimate by how much contours are rendered too narrow on average, [px]."""
    bias = 0.0
    for _ in range(5):
        weights = kernel.weights(shifts - bias) / sds**2
        bias = float((weights * shifts).sum() / max(weights.sum(), 1e-9))
    return bias


def misfits(frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot) -> Array:
    """Compute the mean robust distance (F,), 0..1, between image edges and rendered contours, after removing a common bias.

    The distance is NaN for frames that do not show the arm.
    """
    contours = trace(frames, camera, clock, arm, _CHECK_POINTS)
    costs = np.full(len(frames.times_s), np.nan)
    if not contours:
        return costs
    found = [edge_shifts(item.contour, item.gray, _CHECK_REACH_PX) for item in contours]
    shifts, strength = (np.concatenate(part) for part in zip(*found, strict=True))
    bias = common_bias(shifts, edge_sds(strength), EDGE_KERNEL)
    for item, (own, clear) in zip(contours, found, strict=True):
        costs[item.index] = np.average(EDGE_KERNEL.costs(own - bias), weights=edge_sds(clear) ** -2.0)
    return costs


def misfit(frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot) -> float:
    """Average `misfits` over the frames; infinite if no frame shows the arm."""
    costs = misfits(frames, camera, clock, arm)
    return float(np.nanmean(costs)) if np.isfinite(costs).any() else float("inf")
