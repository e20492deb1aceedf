"""Normal equations of the scan for alignment, joint zeros and fixed cameras in the bundle adjustment."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import (
    AlignmentImage,
    Contour,
    edge_shifts,
    shift_jacobian,
)
from aomgen.alignment.silhouette_fit import RobotDrawing
from aomgen.alignment.silhouette_residuals import (
    BIAS_SD_PX,
    CLEAR_EDGE,
    TOGETHER,
    common_bias,
    robust_weights,
)
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.transforms import apply
from aomgen.core.values import Array

# Contour points a view; errors of closer points are correlated, see `TOGETHER`.
_POINTS = 400
# Information that fixes similarity and joints when no view is used: far above that of any data.
_HELD = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanViews:
    """Scan views at the size they are rendered at, with gray levels."""

    views: list[AlignmentImage]
    grays: list[NDArray[np.float32]]
    drawing: RobotDrawing


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanContour:
    """The contour of the robot as rendered for one scan view.

    Attributes:
        view: Index of the view.
        contour: Its points, world frame.
        turns: How each joint moves the points (C, J, 3), [m/rad].
        zeros_rad: The joint zeros (J,) it was rendered with.
    """

    view: int
    contour: Contour
    turns: Array
    zeros_rad: Array


def trace_scan(scan: ScanViews, S_world_recon: Array, zeros_rad: Array) -> list[ScanContour]:
    """Contours of the robot as scanned, with joint zeros, in the views that show enough of it."""
    configuration = replace(scan.drawing.configuration, joints=scan.drawing.configuration.joints + zeros_rad)
    drawing = replace(scan.drawing, configuration=configuration)
    contours = []
    for index, view in enumerate(scan.views):
        drawn = drawing.draw(camera_in_world(S_world_recon, view.camera_recon), _POINTS)
        if drawn is not None:
            turns = configuration.turns(drawn.contour.points, drawn.bodies)
            contours.append(ScanContour(view=index, contour=drawn.contour, turns=turns, zeros_rad=zeros_rad))
    return contours


def scan_block(
    scan: ScanViews,
    contours: list[ScanContour],
    S_world_recon: Array,
    zeros_rad: Array,
    search: tuple[int, float],
) -> tuple[Array, Array]:
    """Normal equations (7 + J) of a motion of the robot before all views, and of joint zeros.

    All contours may be too wide or too narrow by one bias.
    """
    (reach, kernel), rows, every, clear = search, [], [], []
    for rendered in contours:
        view = scan.views[rendered.view]
        camera = camera_in_world(S_world_recon, view.camera_recon)
        points = rendered.contour.points + np.einsum(
            "j,cjd->cd", zeros_rad - rendered.zeros_rad, rendered.turns
        )
        contour = replace(rendered.contour, points=points).seen_by(camera)
        shifts, strength = edge_shifts(contour, scan.grays[rendered.view], reach)
        J = np.ones((len(shifts), 8 + len(zeros_rad)))
        J[:, :7] = shift_jacobian(camera, contour, scan.drawing.pivot)
        J[:, 7:-1] = np.einsum("cd,cjd->cj", J[:, 3:6], rendered.turns)
        rows.append(J)
        every.append(shifts)
        clear.append(np.minimum(strength / CLEAR_EDGE, 1.0))
    if not rows:
        return _HELD * np.eye(7 + len(zeros_rad)), np.zeros(7 + len(zeros_rad))
    J, shifts, clearness = np.concatenate(rows), np.concatenate(every), np.concatenate(clear)
    residuals = shifts - common_bias(shifts, clearness, kernel)
    weights = robust_weights(residuals, clearness, kernel)
    scale = 1 / (TOGETHER * max(float(weights @ residuals**2 / max(weights.sum(), 1e-9)), 0.01))
    A, b = scale * J.T @ (weights[:, None] * J), scale * J.T @ (weights * residuals)
    A[-1, -1] += 1 / BIAS_SD_PX**2
    bias = A[:-1, -1]
    return A[:-1, :-1] - np.outer(bias, bias) / A[-1, -1], b[:-1] - bias * b[-1] / A[-1, -1]


def structure_rows(
    camera: Camera, camera_recon: Camera, points_recon: Array, S: Array, pivot: Array
) -> tuple[Array, Array]:
    """Reprojection residuals between a camera of the structure and the same camera in the world frame.

    Args:
        camera: World frame.
        camera_recon: The same camera as structure from motion placed it, recon frame, same size.
        points_recon: (P, 3) before the camera.
        S: S_world_recon (4, 4).
        pivot: World point (3,) that motions turn about, [m].

    Returns:
        Rows (2P, 13) for a motion of camera (6: robot moves before it) and similarity (7), and
        the differences (2P,), [px].
    """
    points = apply(S, points_recon)
    seen_from = apply(camera.T_cam_world, points)
    difference = camera_recon.project(points_recon)[0] - camera.project(points)[0]
    x, y, z = seen_from.T
    zero, R = np.zeros(len(z)), camera.T_cam_world[:3, :3]
    arm = points - pivot
    rows = []
    for gradient_cam in (
        camera.fx * np.stack([1 / z, zero, -x / z**2], 1),
        camera.fy * np.stack([zero, 1 / z, -y / z**2], 1),
    ):
        gradient = gradient_cam @ R
        growth = np.einsum("pd,pd->p", gradient, arm)[:, None]
        motion = np.concatenate([np.cross(arm, gradient), gradient], 1)
        # What moves before the camera is the structure; moving the similarity moves it back.
        rows.append(np.concatenate([motion, -motion, -growth], 1))
    return np.concatenate(rows), np.concatenate([difference[:, 0], difference[:, 1]])
