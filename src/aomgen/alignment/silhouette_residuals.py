"""Contour residuals of one fixed camera's video: the moving arm's silhouette in many configurations.

A contour rendered from the joint log differs from the observed one when the camera pose is wrong, when
the clock offset is wrong, or when images show every contour a little too wide or too narrow (blur, tone
curve, simplified meshes). The three can be separated because the arm moves along many directions: a
clock error scales with the velocity of the arm, a contour bias depends on neither pose nor velocity.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import Contour, edge_shifts, outline, shift_jacobian
from aomgen.alignment.silhouette_fit import gray_levels
from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.core.joint_log import JointLog
from aomgen.core.transforms import invert
from aomgen.core.values import Array, freeze
from aomgen.io.images import resize
from aomgen.io.video import Video
from aomgen.robots.configuration import RobotConfiguration
from aomgen.robots.robot import RobotModel
from aomgen.robots.silhouette import SilhouetteRenderer

# Columns of the equations: rotation and translation of the robot before the camera, clock offset,
# drift, bias of the contours; the zero of each arm joint follows.
POSE, OFFSET, RATE, BIAS = slice(0, 6), 6, 7, 8
# Six of the pose, then offset, rate and bias.
COLUMNS = 9
# Readings within this time to either side are averaged against encoder noise, [s].
_READING_S = 0.02
# Half of the time over which velocities are differentiated, [s]: twice the averaging time, against encoder
# noise.
_SPEED_S = 0.05
# Gray-level step of an edge that counts fully.
CLEAR_EDGE = 0.05
# Errors of neighbouring contour points are correlated: ten points count as one.
TOGETHER = 10.0
# How far blur, tone curves and simple meshes widen all contours of one camera, [px].
BIAS_SD_PX = 1.0
# Least and largest share of the image that the robot may cover: below is no signal, above no contour.
_SHARES = (0.002, 0.7)
# Contour points without which a frame does not determine six degrees of freedom.
_MIN_POINTS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class GrayFrames:
    """Chosen frames of a video, as gray levels.

    Attributes:
        times_s: Video times (F,).
        grays: Gray levels (F, H, W), 0..1.
    """

    times_s: Array
    grays: NDArray[np.float32]

    def __post_init__(self) -> None:
        freeze(self, "times_s", self.times_s, (len(self.grays),))


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedRobot:
    """The robot, its joint log, the joint zeros (J,) that are added to it [rad], and its renderer."""

    robot: RobotModel
    log: JointLog
    renderer: SilhouetteRenderer
    zeros_rad: Array

    def __post_init__(self) -> None:
        freeze(self, "zeros_rad", self.zeros_rad, (self.log.joints.shape[1],))

    def states(self, log_times_s: Array) -> tuple[Array, Array]:
        """Joints (T, J) and gripper (T,) at log times (T,), encoder noise averaged."""
        offsets = np.linspace(-_READING_S, _READING_S, 5)
        readings = [self.log.at(log_times_s + offset) for offset in offsets]
        return np.mean([q for q, _ in readings], 0) + self.zeros_rad, np.mean([g for _, g in readings], 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameContour:
    """The contour of the arm as rendered for one frame.

    Attributes:
        frame: Index into the frames.
        contour: Its points, world frame.
        velocities: Of the points (C, 3), per second of the log, [m/s].
        turns: How each joint moves the points (C, J, 3), [m/rad].
        clock: The clock it was rendered with.
        zeros_rad: The joint zeros (J,) it was rendered with.
    """

    frame: int
    contour: Contour
    velocities: Array
    turns: Array
    clock: Clock
    zeros_rad: Array


def empty_frames() -> GrayFrames:
    """No frames."""
    return GrayFrames(times_s=np.zeros(0), grays=np.zeros((0, 1, 1), np.float32))


def read_gray_frames(video: Video, frames: NDArray[np.int64], width: int) -> GrayFrames:
    """Gray levels of some frames, at most `width` wide."""
    if not len(frames):
        return empty_frames()
    full = video.frames_srgb.shape[2]
    size = (min(full, width), round(video.frames_srgb.shape[1] * min(1.0, width / full)))
    grays = [gray_levels(resize(video.frames_srgb[k], *size)) for k in frames]
    return GrayFrames(times_s=video.times_s[frames], grays=np.stack(grays))


def choose_frames(video: Video, arm: LoggedRobot, clock: Clock, count: int) -> NDArray[np.int64]:
    """At most `count` frames, evenly along the end effector's path, that the log covers."""
    covered = np.flatnonzero(arm.log.covers(clock.log_times(video.times_s)))
    if not len(covered):
        return covered
    places = arm.robot.ee_poses(arm.states(clock.log_times(video.times_s[covered]))[0])[:, :3, 3]
    # Where the arm rests, time alone parts the frames a little.
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) + 1e-4
    path = np.concatenate([[0.0], np.cumsum(steps)])
    marks = (np.arange(count) + 0.5) / count * path[-1]
    return covered[np.unique(np.searchsorted(path, marks))]


def trace(
    frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot, points: int
) -> list[FrameContour]:
    """Contours in the frames that show enough of the arm, at most `points` points each."""
    if not len(frames.times_s):
        return []
    times = clock.log_times(frames.times_s)
    joints, gripper = arm.states(times)
    before, after = (arm.robot.link_poses(*arm.states(times + step)) for step in (-_SPEED_S, _SPEED_S))
    poses = arm.robot.link_poses(joints, gripper)
    contours = []
    for k in range(len(times)):
        bodies, depth = arm.renderer.draw(camera, joints[k], float(gripper[k]))
        mask = bodies >= 0
        if not _SHARES[0] < mask.mean() < _SHARES[1]:
            continue
        contour = outline(camera, mask, depth, points)
        if len(contour.pixels) < _MIN_POINTS:
            continue
        # The outline runs half a pixel outside the pixels it was found on.
        columns, rows = np.floor(contour.pixels - 0.5 * contour.normals).astype(int).T
        seen = bodies[rows, columns]
        moves = ((after[k] - before[k]) @ invert(poses[k]) / (2 * _SPEED_S))[seen]
        velocities = np.einsum("cij,cj->ci", moves[:, :3, :3], contour.points) + moves[:, :3, 3]
        configuration = RobotConfiguration(robot=arm.robot, joints=joints[k], gripper=float(gripper[k]))
        contours.append(
            FrameContour(
                frame=k,
                contour=contour,
                velocities=velocities,
                turns=configuration.turns(contour.points, seen),
                clock=clock,
                zeros_rad=arm.zeros_rad,
            )
        )
    return contours


def move_contour(
    rendered: FrameContour, time_s: float, camera: Camera, clock: Clock, zeros_rad: Array
) -> FrameContour:
    """Linearly move a contour to a nearby camera pose, clock and joint zeros, without rendering again.

    Args:
        rendered: Contour to move.
        time_s: Video time of its frame.
        camera: Same size, nearly the same pose.
        clock, zeros_rad: Close to those of `rendered`.
    """
    delay = float(clock.log_times([time_s])[0] - rendered.clock.log_times([time_s])[0])
    turned = np.einsum("j,cjd->cd", zeros_rad - rendered.zeros_rad, rendered.turns)
    points = rendered.contour.points + delay * rendered.velocities + turned
    contour = replace(
        rendered.contour, points=points, pixels=camera.project(points)[0] + 0.5 * rendered.contour.normals
    )
    return replace(rendered, contour=contour, clock=clock, zeros_rad=zeros_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class ContourResiduals:
    """Linear equations of one contour, `jacobian @ step = shifts`.

    Attributes:
        jacobian: (C, COLUMNS + J), [px] per [rad], [m], [s], 1, [px], [rad].
        shifts: From the rendered contour to the image edge, along the normals (C,), [px].
        clearness: Strength of the edge (C,), 0..1.
    """

    jacobian: Array
    shifts: Array
    clearness: Array


def contour_residuals(
    frames: GrayFrames, rendered: FrameContour, camera: Camera, pivot: Array, reach: int
) -> ContourResiduals:
    """Residuals of one frame, linear in pose (about `pivot`), clock, bias and joint zeros."""
    contour = rendered.contour
    shifts, strength = edge_shifts(contour, frames.grays[rendered.frame], reach)
    full = shift_jacobian(camera, contour, pivot)
    jacobian = np.empty((len(shifts), COLUMNS + len(rendered.zeros_rad)))
    jacobian[:, POSE] = full[:, :6]
    jacobian[:, OFFSET] = np.einsum("cd,cd->c", full[:, 3:6], rendered.velocities)
    jacobian[:, RATE] = jacobian[:, OFFSET] * (frames.times_s[rendered.frame] - rendered.clock.middle_s)
    jacobian[:, BIAS] = 1.0
    jacobian[:, COLUMNS:] = np.einsum("cd,cjd->cj", full[:, 3:6], rendered.turns)
    return ContourResiduals(
        jacobian=jacobian, shifts=shifts, clearness=np.minimum(strength / CLEAR_EDGE, 1.0)
    )


def robust_weights(residuals: Array, clearness: Array, kernel_px: float) -> Array:
    """Geman and McClure's weights (C,) times the clearness of the edges."""
    return clearness / (1 + (residuals / kernel_px) ** 2) ** 2


def common_bias(shifts: Array, clearness: Array, kernel_px: float) -> float:
    """By how much contours are rendered too narrow, in the mean, [px]."""
    bias = 0.0
    for _ in range(5):
        weights = robust_weights(shifts - bias, clearness, kernel_px)
        bias = float((weights * shifts).sum() / max(weights.sum(), 1e-9))
    return bias


def misfits(frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot, reach: int = 4) -> Array:
    """Mean robust distance (F,), 0..1, between image edges and rendered contour in each frame; one bias is free.

    NaN for frames that do not show the arm.
    """
    contours = trace(frames, camera, clock, arm, 300)
    costs = np.full(len(frames.times_s), np.nan)
    found = [contour_residuals(frames, rendered, camera, np.zeros(3), reach) for rendered in contours]
    shifts = np.concatenate([item.shifts for item in found] or [np.zeros(0)])
    clearness = np.concatenate([item.clearness for item in found] or [np.zeros(0)])
    bias = common_bias(shifts, clearness, 1.0)
    for rendered, item in zip(contours, found, strict=True):
        squares = (item.shifts - bias) ** 2
        total = max(item.clearness.sum(), 1e-9)
        costs[rendered.frame] = float((item.clearness * squares / (1 + squares)).sum() / total)
    return costs


def misfit(frames: GrayFrames, camera: Camera, clock: Clock, arm: LoggedRobot) -> float:
    """Mean of `misfits` over the frames; infinite when none shows the arm."""
    costs = misfits(frames, camera, clock, arm)
    shown = costs[~np.isnan(costs)]
    return float(shown.mean()) if len(shown) else float("inf")
