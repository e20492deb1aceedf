"""Evidence of the bundle adjustment as residual terms of similarity, joint zeros, cameras and clocks.

The unknowns are a correction of `S_world_recon`, the zero of each arm joint, and for each fixed camera its pose, the offset and
drift of its clock and the bias of its contours. The evidence consists of the contours of the arm in videos and scan views
(`arm_contours`), the pose of each camera by structure from motion, and hand-eye calibrations.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Final

import numpy as np

from aomgen.alignment.arm_contours import ArmContour, GrayFrames, LoggedRobot, trace, trace_scan
from aomgen.alignment.contours import (
    CORRELATED_POINTS,
    AlignmentImage,
    Contour,
    edge_sds,
    edge_shifts,
    shift_jacobian,
)
from aomgen.alignment.silhouette_fit import RobotDrawing, move_similarity
from aomgen.alignment.uncertainty import JACKKNIFE_GROUPS
from aomgen.conventions import luma_from_srgb
from aomgen.core.alignment import Clock
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.least_squares import Kernel, ResidualTerm
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, rotvec_from_matrix, transform
from aomgen.core.values import Array, Matrix4, freeze_arrays

# Unknowns of a camera: rotation and translation of the robot relative to it, clock offset, drift, bias.
_POSE, OFFSET, RATE, _BIAS, _COLUMNS = slice(0, 6), 6, 7, 8, 9
# Least standard deviation of an edge, [px].
_EDGE_SD_PX = 0.1
# Standard deviation by which blur, tone curves and simple meshes widen all contours of one camera, [px].
_BIAS_SD_PX = 1.0
# Standard deviation of a known quantity, in its unit: far below that of any data.
KNOWN_SD = 1e-6
# Number of points that represent the pose of a camera in the structure; sufficient for six degrees of freedom.
_STRUCTURE_POINTS = 300
# Standard deviation of a camera that is registered in the structure, in its image, [px]: about half the reprojection error of a
# single image.
_STRUCTURE_SD_PX = 0.25
# Assumed standard deviations of a hand-eye calibration: position [m] and rotation [rad], 0.2 degrees.
CALIBRATION_SD_M, CALIBRATION_SD_RAD = 0.003, 0.0035
# Prefix of the names of terms that the jackknife leaves out.
SEGMENT: Final = "segment of "


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleParams:
    """Priors and effort of the bundle adjustment.

    Attributes:
        frames: Number of frames of each video; 0 keeps the poses of the cameras in the scan.
        width: Largest width of the images, [px].
        points: Number of contour points of a frame.
        zero_sd_rad, zero_sd_m: Standard deviations of the zeros of revolute and prismatic joints of a calibrated arm; values
            near 0 keep those of the log.
    """

    frames: int = 32
    width: int = 640
    points: int = 300
    zero_sd_rad: float = float(np.radians(0.3))
    zero_sd_m: float = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEvidence:
    """Data of one fixed camera.

    Attributes:
        camera_recon: Camera as estimated by structure from motion, recon frame, at the size of the frames.
        frames, held_out: Frames to fit, and frames that validate the result; both may be empty.
        clock: First guess; its `sd_s` 0 means that it is known.
        T_world_cam: Hand-eye calibration to use as a prior, or None.
        rejected: Reason for which the video is not used; empty if it is used.
    """

    camera_recon: Camera
    frames: GrayFrames
    held_out: GrayFrames
    clock: Clock
    T_world_cam: Array | None = None
    rejected: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleProblem:
    """Data and initial values of the bundle adjustment.

    Attributes:
        views: Scan views at the size of their renderings.
    """

    S_world_recon: Array
    views: list[AlignmentImage]
    drawing: RobotDrawing
    points_recon: Array
    arm: LoggedRobot
    cameras: dict[str, CameraEvidence]
    params: BundleParams = field(default_factory=BundleParams)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraState:
    """Unknowns of one camera: pose, clock, bias of the contours [px]."""

    camera: Camera
    clock: Clock
    bias_px: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleSolution:
    """Similarity (4, 4), joint zeros (J,) [rad] or [m] to add to the log's with their deviations, cameras by name.

    Contours of the scan are `scan_bias_px` wider than rendered.
    """

    S_world_recon: Matrix4
    zeros_rad: Annotated[Array, "N"]
    zero_sds_rad: Annotated[Array, "N"]
    cameras: dict[str, CameraState]
    scan_bias_px: float = 0.0

    __post_init__ = freeze_arrays


class Bundle:
    """Terms of a problem; a step holds similarity (7), joint zeros (J), bias of the scan, _COLUMNS a camera."""

    def __init__(self, problem: BundleProblem) -> None:
        self.problem, self.pivot = problem, problem.drawing.pivot
        self.grays = [luma_from_srgb(view.image_srgb) for view in problem.views]
        self.zeros = slice(7, 7 + len(problem.arm.zeros_rad))
        self.scan_bias = self.zeros.stop
        self.first = {name: self.scan_bias + 1 + _COLUMNS * k for k, name in enumerate(problem.cameras)}
        self.dimension = self.scan_bias + 1 + _COLUMNS * len(self.first)

    def move(self, x: BundleSolution, step: Array) -> BundleSolution:
        """Update a solution by a step: robot relative to each camera, similarity, joint zeros, biases and clocks."""
        cameras = {}
        for name, item in x.cameras.items():
            own = step[self.first[name] :][:_COLUMNS]
            pose = np.clip(own[_POSE], -0.05, 0.05)
            R = matrix_from_rotvec(pose[:3])
            D = transform(R, self.pivot + pose[3:] - R @ self.pivot)
            clock = replace(
                item.clock,
                offset_s=item.clock.offset_s + float(np.clip(own[OFFSET], -0.1, 0.1)),
                rate=item.clock.rate + float(np.clip(own[RATE], -0.02, 0.02)),
            )
            camera = item.camera.move(invert(D) @ item.camera.T_world_cam)
            cameras[name] = CameraState(camera=camera, clock=clock, bias_px=item.bias_px + float(own[_BIAS]))
        return replace(
            x,
            S_world_recon=move_similarity(x.S_world_recon, step[:7], self.pivot),
            zeros_rad=x.zeros_rad + step[self.zeros],
            scan_bias_px=x.scan_bias_px + float(step[self.scan_bias]),
            cameras=cameras,
        )

    def priors(self) -> list[ResidualTerm[BundleSolution]]:
        """List the terms that need no contour."""
        params, slides = self.problem.params, self.problem.arm.robot.slides
        zero_sds = np.where(slides, params.zero_sd_m, params.zero_sd_rad)
        terms: list[ResidualTerm[BundleSolution]] = [
            ResidualTerm(name="joint zeros", residual=lambda x: x.zeros_rad, sd=zero_sds),
            ResidualTerm(name="scan bias", residual=lambda x: np.array([x.scan_bias_px]), sd=_BIAS_SD_PX),
        ]
        for name, item in self.problem.cameras.items():
            terms += _camera_priors(name, item, self.problem.points_recon)
        return terms

    def contours(self, x: BundleSolution, reach: int, kernel: Kernel) -> list[ResidualTerm[BundleSolution]]:
        """Render contours at a solution, and list the terms of the scan and of each segment of each video."""
        problem, S = self.problem, x.S_world_recon
        scan = trace_scan(problem.views, self.grays, problem.drawing, S, x.zeros_rad)
        if scan:
            terms = self._edges(None, x, [scan], reach, kernel)
        else:
            terms = [
                ResidualTerm(name="scan", residual=lambda x: (x.S_world_recon - S)[:3].ravel(), sd=KNOWN_SD)
            ]
        arm = replace(problem.arm, zeros_rad=x.zeros_rad)
        for name, item in problem.cameras.items():
            count, state = len(item.frames.times_s), x.cameras[name]
            drawn = trace(item.frames, state.camera, state.clock, arm, problem.params.points)
            parts = [
                [one for one in drawn if one.index * JACKKNIFE_GROUPS // count == k]
                for k in range(JACKKNIFE_GROUPS)
            ]
            terms += self._edges(name, x, [part for part in parts if part], reach, kernel)
        return terms

    def _edges(
        self, name: str | None, x: BundleSolution, parts: list[list[ArmContour]], reach: int, kernel: Kernel
    ) -> list[ResidualTerm[BundleSolution]]:
        """List the terms of shifts from contours to image edges, less their bias, [px], for parts of a video or for the scan.

        Their standard deviation is that of the current residuals.
        """
        if not parts:
            return []
        found = [edge_shifts(one.contour, one.gray, reach) for part in parts for one in part]
        shifts, strength = (np.concatenate(values) for values in zip(*found, strict=True))
        residuals = shifts - self._bias(name, x)
        weights = kernel.weights(residuals) / edge_sds(strength) ** 2
        sd = max(_EDGE_SD_PX, float(np.sqrt(np.average(residuals**2, weights=weights))))
        sds = np.sqrt(CORRELATED_POINTS) * sd * edge_sds(strength)
        ends = np.cumsum([sum(len(one.turns) for one in part) for part in parts])

        def residual(part: list[ArmContour], x: BundleSolution) -> Array:
            found = [edge_shifts(self._see(name, x, one)[1], one.gray, reach)[0] for one in part]
            return np.concatenate(found) - self._bias(name, x)

        return [
            ResidualTerm(
                name=f"{SEGMENT}{name} {k}" if name else "scan",
                residual=partial(residual, part),
                sd=own,
                kernel=kernel,
                jacobian=partial(self._jacobian, name, part),
            )
            for k, (part, own) in enumerate(zip(parts, np.split(sds, ends[:-1]), strict=True))
        ]

    def _bias(self, name: str | None, x: BundleSolution) -> float:
        return x.cameras[name].bias_px if name else x.scan_bias_px

    def _see(self, name: str | None, x: BundleSolution, one: ArmContour) -> tuple[Camera, Contour]:
        """Return the camera of a contour at a solution, and the contour as this camera sees it."""
        if name is None:
            camera = camera_in_world(x.S_world_recon, self.problem.views[one.index].camera_recon)
            return camera, one.at(camera, x.zeros_rad)
        state, times_s = x.cameras[name], self.problem.cameras[name].frames.times_s
        log_time_s = float(state.clock.log_times(times_s[one.index]))
        return state.camera, one.at(state.camera, x.zeros_rad, log_time_s)

    def _jacobian(self, name: str | None, part: list[ArmContour], x: BundleSolution) -> Array:
        rows = []
        for one in part:
            camera, contour = self._see(name, x, one)
            motion = shift_jacobian(camera, contour, self.pivot)
            J = np.zeros((len(motion), self.dimension))
            J[:, self.zeros] = np.einsum("cd,cjd->cj", motion[:, 3:6], one.turns)
            if name is None:
                J[:, :7], J[:, self.scan_bias] = motion, 1.0
            else:
                first, clock = self.first[name], x.cameras[name].clock
                time_s = self.problem.cameras[name].frames.times_s[one.index]
                J[:, first : first + 6], J[:, first + _BIAS] = motion[:, :6], 1.0
                J[:, first + OFFSET] = np.einsum("cd,cd->c", motion[:, 3:6], one.velocities)
                J[:, first + RATE] = J[:, first + OFFSET] * (time_s - clock.middle_s)
            rows.append(-J)
        return np.concatenate(rows)


def _camera_priors(
    name: str, item: CameraEvidence, points_recon: Array
) -> list[ResidualTerm[BundleSolution]]:
    """List the terms of a camera's pose by structure and calibration, of its bias, and of its clock if that is known."""
    terms: list[ResidualTerm[BundleSolution]] = [
        ResidualTerm(
            name=f"{name} bias", residual=lambda x: np.array([x.cameras[name].bias_px]), sd=_BIAS_SD_PX
        )
    ]
    pixels, depths = item.camera_recon.project(points_recon)
    size = np.array([item.camera_recon.width, item.camera_recon.height])
    seen = np.flatnonzero((depths > 0) & np.all((pixels > 0) & (pixels < size), axis=1))
    chosen = seen[:: max(1, len(seen) // _STRUCTURE_POINTS)]

    def move_px(x: BundleSolution) -> Array:
        points = apply(x.S_world_recon, points_recon[chosen])
        return (x.cameras[name].camera.project(points)[0] - pixels[chosen]).ravel()

    if len(chosen):
        # Each of the six degrees of freedom has the standard deviation `_STRUCTURE_SD_PX`.
        sd = _STRUCTURE_SD_PX * np.sqrt(2 * len(chosen) / 6)
        terms.append(ResidualTerm(name=f"{name} in structure", residual=move_px, sd=sd))
    if item.T_world_cam is not None:
        T = item.T_world_cam
        sds = np.repeat([CALIBRATION_SD_RAD, CALIBRATION_SD_M], 3)
        terms.append(
            ResidualTerm(
                name=f"{name} calibrated",
                residual=lambda x: pose_difference(x.cameras[name].camera, T),
                sd=sds,
            )
        )
    if not item.clock.sd_s > 0:
        known = np.array([item.clock.offset_s, item.clock.rate])
        terms.append(
            ResidualTerm(name=f"{name} clock", residual=lambda x: _clock(x, name) - known, sd=KNOWN_SD)
        )
    return terms


def pose_difference(camera: Camera, T_world_cam: Array) -> Array:
    """Compute the rotation vector [rad] and translation [m], together (6,), from a pose (4, 4) to a camera, world axes."""
    turn = rotvec_from_matrix(camera.T_world_cam[:3, :3] @ T_world_cam[:3, :3].T)
    return np.concatenate([turn, camera.center - T_world_cam[:3, 3]])


def _clock(x: BundleSolution, name: str) -> Array:
    return np.array([x.cameras[name].clock.offset_s, x.cameras[name].clock.rate])
