"""Normal equations of the bundle adjustment, from videos, structure and hand-eye calibrations."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.scan_information import ScanViews, structure_rows
from aomgen.alignment.silhouette_residuals import (
    BIAS,
    BIAS_SD_PX,
    COLUMNS,
    OFFSET,
    RATE,
    TOGETHER,
    ContourResiduals,
    FrameContour,
    GrayFrames,
    LoggedRobot,
    contour_residuals,
    move_contour,
    robust_weights,
)
from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.core.transforms import rotvec_from_matrix, skew
from aomgen.core.values import Array

# Segments of a video that are left out in turn (jackknife).
_SEGMENTS = 8
# Information that fixes an unknown: far above that of any data.
FIXED = 1e12
# Points that carry the pose of a camera in the structure; six degrees of freedom need no more.
STRUCTURE_POINTS = 300
# How far a camera placed in the structure is off, in its own image, [px]: about half the reprojection error
# of a single image.
STRUCTURE_SD_PX = 0.25
# Standard deviation assumed of a hand-eye calibration, [m].
CALIBRATION_SD_M = 0.003
# The same of its rotation, [rad], 0.2 degrees.
CALIBRATION_SD_RAD = 0.0035
# Least standard deviation of a clock, [s]: time stamps are rounded to a millisecond.
MIN_SD_S = 0.001
# A drift that shifts the ends of the video by less than this against one another is none: 20 ms at either
# end are 6 mm of an arm that moves at 0.3 m/s, [s].
MAX_DRIFT_S = 0.04
# Standard deviations that a drift has to be away from none; four, so that chance never makes one.
DRIFT_SDS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleParams:
    """Priors and effort.

    Attributes:
        frames: Frames of each video; 0 leaves cameras where the scan placed them.
        width: Images wider than this are reduced, [px].
        points: Contour points a frame.
        calibration_sd_m, calibration_sd_rad: What a hand-eye calibration is good to.
        zero_sd_rad: How far the zero of a joint of a mastered arm is off; next to 0 keeps the log's.
    """

    frames: int = 32
    width: int = 640
    points: int = 300
    zero_sd_rad: float = float(np.radians(0.3))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEvidence:
    """Data of one fixed camera.

    Attributes:
        camera_recon: As structure from motion placed it, recon frame, at the size of the frames.
        frames: Frames to fit.
        clock: First guess; its `sd_s` 0 means that it is known.
        T_world_cam: Hand-eye calibration to use as a prior, or None.
    """

    camera_recon: Camera
    frames: GrayFrames
    clock: Clock
    T_world_cam: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraState:
    """Unknowns of one camera: pose, clock, bias of the contours [px]."""

    camera: Camera
    clock: Clock
    bias_px: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleProblem:
    """Data and initial values of the bundle adjustment.

    Attributes:
        S_world_recon: Aligned similarity (4, 4).
        scan: Views of the robot as scanned.
        points_recon: The structure's points (P, 3).
        arm: Robot, log and renderer.
        cameras: By name.
        params: Priors and effort.
    """

    S_world_recon: Array
    scan: ScanViews
    points_recon: Array
    arm: LoggedRobot
    cameras: dict[str, CameraEvidence]
    params: BundleParams = field(default_factory=BundleParams)

    @property
    def pivot(self) -> Array:
        """World point (3,) that motions turn about, [m]."""
        return self.scan.drawing.pivot


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """Columns of the unknowns: similarity (7), joint zeros (J), then COLUMNS for each camera."""

    joints: int
    cameras: int

    @property
    def count(self) -> int:
        """Of all unknowns."""
        return 7 + self.joints + COLUMNS * self.cameras

    @property
    def zeros(self) -> slice:
        """Of the joint zeros."""
        return slice(7, 7 + self.joints)

    def camera(self, k: int) -> slice:
        """Of camera `k`."""
        start = 7 + self.joints + COLUMNS * k
        return slice(start, start + COLUMNS)

    def frames(self, k: int) -> NDArray[np.int64]:
        """Those that the video of camera `k` depends on, in the order of `ContourResiduals.jacobian`."""
        every = np.arange(self.count)
        return np.concatenate([every[self.camera(k)], every[self.zeros]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Normal equations of one camera's video, and those of each segment of it; see `Columns.frames`."""

    A: Array
    b: Array
    segments: list[tuple[Array, Array]]


def camera_block(
    problem: BundleProblem,
    name: str,
    state: CameraState,
    zeros_rad: Array,
    contours: list[FrameContour],
    search: tuple[int, float],
) -> Block:
    frames, (reach, kernel) = problem.cameras[name].frames, search
    found: list[tuple[int, ContourResiduals]] = []
    for rendered in contours:
        here = move_contour(rendered, frames.times_s[rendered.frame], state.camera, state.clock, zeros_rad)
        found.append((rendered.frame, contour_residuals(frames, here, state.camera, problem.pivot, reach)))
    parts, squares, total = [], 0.0, 0.0
    for frame, item in found:
        residuals = item.shifts - state.bias_px
        weights = robust_weights(residuals, item.clearness, kernel)
        J = item.jacobian
        parts.append((frame, J.T @ (weights[:, None] * J), J.T @ (weights * residuals)))
        squares, total = squares + float(weights @ residuals**2), total + float(weights.sum())
    # Edges are trusted to a tenth of a pixel at best (its square, [px^2]).
    scale = 1 / (TOGETHER * max(squares / max(total, 1e-9), 0.01))
    segment = [frame * _SEGMENTS // len(frames.times_s) for frame, _, _ in parts]
    segments = []
    for index in range(_SEGMENTS):
        mine = [part for part, at in zip(parts, segment, strict=True) if at == index]
        if mine:
            segments.append((scale * sum(A for _, A, _ in mine), scale * sum(b for _, _, b in mine)))
    size = COLUMNS + len(zeros_rad)
    zero = (np.zeros((size, size)), np.zeros(size))
    return Block(
        A=sum((A for A, _ in segments), zero[0]),
        b=sum((b for _, b in segments), zero[1]),
        segments=segments,
    )


def assemble(
    problem: BundleProblem,
    scan: tuple[Array, Array],
    blocks: dict[str, Block],
    S: Array,
    zeros_rad: Array,
    states: dict[str, CameraState],
) -> tuple[Array, Array]:
    """Normal equations of all unknowns, see `Columns`."""
    columns = Columns(joints=len(zeros_rad), cameras=len(blocks))
    A, b = 1e-9 * np.eye(columns.count), np.zeros(columns.count)
    robot = slice(0, columns.zeros.stop)
    A[robot, robot] += scan[0]
    b[robot] += scan[1]
    prior = 1 / problem.params.zero_sd_rad**2
    A[columns.zeros, columns.zeros] += prior * np.eye(columns.joints)
    b[columns.zeros] -= prior * zeros_rad
    for k, (name, block) in enumerate(blocks.items()):
        at, item, state = columns.camera(k), problem.cameras[name], states[name]
        frames = columns.frames(k)
        A[np.ix_(frames, frames)] += block.A
        b[frames] += block.b
        pose = np.arange(at.start, at.start + 6)
        _add(A, b, np.concatenate([pose, np.arange(7)]), _structure_prior(problem, item, state, S))
        if item.T_world_cam is not None:
            _add(A, b, pose, _calibration_prior(problem, item.T_world_cam, state))
        first = at.start
        A[first + BIAS, first + BIAS] += 1 / BIAS_SD_PX**2
        b[first + BIAS] -= state.bias_px / BIAS_SD_PX**2
        if not item.clock.sd_s > 0:
            A[first + OFFSET, first + OFFSET] += FIXED
            A[first + RATE, first + RATE] += FIXED
    return A, b


def _add(A: Array, b: Array, columns: NDArray[np.int64], rows: tuple[Array, Array]) -> None:
    J, r = rows
    A[np.ix_(columns, columns)] += J.T @ J
    b[columns] += J.T @ r


def _structure_prior(
    problem: BundleProblem, item: CameraEvidence, state: CameraState, S: Array
) -> tuple[Array, Array]:
    camera, points = item.camera_recon, problem.points_recon
    pixels, depths = camera.project(points)
    size = np.array([camera.width, camera.height])
    seen = np.flatnonzero((depths > 0) & np.all((pixels > 0) & (pixels < size), axis=1))
    chosen = seen[:: max(1, len(seen) // STRUCTURE_POINTS)]
    if not len(chosen):
        return np.zeros((0, 13)), np.zeros(0)
    J, r = structure_rows(state.camera, camera, points[chosen], S, problem.pivot)
    # Six degrees of freedom, each known to `STRUCTURE_SD_PX`.
    scale = np.sqrt(6 / len(r)) / STRUCTURE_SD_PX
    return scale * J, scale * r


def _calibration_prior(problem: BundleProblem, T_world_cam: Array, state: CameraState) -> tuple[Array, Array]:
    T = state.camera.T_world_cam
    turn = rotvec_from_matrix(T_world_cam[:3, :3] @ T[:3, :3].T)
    J, r = np.zeros((6, 6)), np.zeros(6)
    J[:3, :3], r[:3] = -np.eye(3), turn
    J[3:, :3], J[3:, 3:], r[3:] = skew(T[:3, 3] - problem.pivot), -np.eye(3), T_world_cam[:3, 3] - T[:3, 3]
    sds = np.repeat([CALIBRATION_SD_RAD, CALIBRATION_SD_M], 3)
    return J / sds[:, None], r / sds
