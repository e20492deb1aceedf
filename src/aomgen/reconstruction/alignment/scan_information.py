"""What the scan says about alignment and fixed cameras, as information for the joint refinement."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze
from aomgen.reconstruction.alignment.contours import (
    View,
    edge_shifts,
    shift_gradient,
    shift_jacobian,
)
from aomgen.reconstruction.alignment.film_outlines import (
    BIAS_SD_PX,
    CLEAR_EDGE,
    TOGETHER,
    robust_weights,
)
from aomgen.reconstruction.alignment.outline_fit import RobotDrawing, camera_in_world, gray_levels

_REACH_PX = 4
_POINTS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanInformation:
    """What the scan says of the robot's motion (7) and joint zeros (J): `information @ step = pull`.

    Attributes:
        information: (7 + J, 7 + J).
        pull: (7 + J,), at the alignment with the joints as logged.
    """

    information: Array
    pull: Array

    def __post_init__(self) -> None:
        freeze(self, "pull", self.pull, (None,))
        freeze(self, "information", self.information, (len(self.pull),) * 2)


def scan_information(S_world_recon: Array, views: list[View], drawing: RobotDrawing) -> ScanInformation:
    """Information of the outlines in scan views, about the middle of the robot.

    All outlines may be drawn too wide or too narrow by one bias.

    Args:
        S_world_recon: The alignment (4, 4), which fits these views.
        views: Scan images of the size to be drawn.
        drawing: Robot as scanned.
    """
    size = 8 + len(drawing.posture.joints)
    A, b, squares, total = np.zeros((size, size)), np.zeros(size), 0.0, 0.0
    for view in views:
        camera = camera_in_world(S_world_recon, view.camera_recon)
        drawn = drawing.draw(camera, _POINTS)
        if drawn is None:
            continue
        contour = drawn.contour
        shifts, strength = edge_shifts(contour, gray_levels(view.image_srgb), _REACH_PX)
        weights = robust_weights(shifts, np.minimum(strength / CLEAR_EDGE, 1.0), 1.0)
        J = np.ones((len(shifts), size))
        J[:, :7] = shift_jacobian(camera, contour, drawing.pivot)
        turns = drawing.posture.turns(contour.points, drawn.bodies)
        J[:, 7:-1] = np.einsum("cd,cjd->cj", shift_gradient(camera, contour), turns)
        A += J.T @ (weights[:, None] * J)
        b += J.T @ (weights * shifts)
        squares, total = squares + float(weights @ shifts**2), total + float(weights.sum())
    scale = 1 / (TOGETHER * max(squares / max(total, 1e-9), 0.01))
    A, b = scale * A, scale * b
    A[-1, -1] += 1 / BIAS_SD_PX**2
    other = A[:-1, -1]
    return ScanInformation(
        information=A[:-1, :-1] - np.outer(other, other) / A[-1, -1],
        pull=b[:-1] - other * b[-1] / A[-1, -1],
    )


def structure_rows(
    camera: Camera, camera_recon: Camera, points_recon: Array, S: Array, pivot: Array
) -> tuple[Array, Array]:
    """Where structure from motion sees the structure's points against where `camera` sees them.

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
