"""Confirmation of rendered contours by image edges and colors, and the shifts that would improve their fit.

The share of confirmed points alone is not sufficient evidence, because clutter confirms contours at any position.
Therefore each contour is also shifted within its image; the share that is confirmed there estimates chance. A
rotation of the last joint moves only the contour of the gripper, beyond the search range, and a part of this contour
is confirmed by chance. Therefore other rotations of this joint are rendered as well.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import (
    CORRELATED_POINTS,
    AlignmentImage,
    Contour,
    border_kernel,
    color_ratio,
    edge_sds,
    edge_shifts,
    region_shifts,
    shift_gradient,
    shift_jacobian,
)
from aomgen.alignment.silhouette_fit import EDGE_KERNEL, RenderedRobot, RobotDrawing
from aomgen.conventions import luma_from_srgb
from aomgen.core.camera import camera_in_world
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotConfiguration

# Largest distance and least strength of an edge that confirms a point, and largest distance of a color border.
NEAR_EDGE_PX, MIN_STEP, NEAR_BORDER_PX = 2.0, 0.02, 3.0
REACH_PX, BORDER_REACH_PX = 8, 16
# Shift of the outlines that estimate chance, as a share of the image width: larger than the search range, but small
# enough that they cross the same surroundings.
ASIDE = 0.06
# Rotations beyond the search range of edges, and close enough to each other that one of them is near any rotation. A
# parallel gripper has the same outline after a rotation by 180 degrees.
TURNS_DEG = (-60.0, -30.0, -15.0, 15.0, 30.0, 60.0, 90.0)
# Standard deviations by which a rotated wrist must fit better, so that chance does not report one.
CLEAR_SDS = 3.0
# Segments with fewer contour points are not evaluated; ten neighboring points count as one.
MIN_SEGMENT_POINTS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEvidence:
    """Evidence of one image for the contour rendered into it; C points, J arm joints.

    Attributes:
        segments: Number (C,) of arm joints that move the body at each point.
        by_chance: (D,) bool, whether the points that remain in the image after the shift are confirmed.
        edge_px, edge_weights: Signed outward distance to the image edge (C,), and its weight.
        border_px, border_weights: The same for the border between two colors, with a larger search range.
        jacobian: (C, 7), see `shift_jacobian`, about the end effector.
        joint_jacobian: (C, J), shift of the outline for a motion of each joint, [px/rad] or [px/m].
        camera_jacobian: (C, 6), shift of the outline for an error of the camera: center [m], then rotation
            vector [rad], world frame.
    """

    name: str
    segments: Annotated[NDArray[np.int64], "C"]
    confirmed: NDArray[np.bool_]
    by_chance: NDArray[np.bool_]
    edge_px: Annotated[Array, "C"]
    edge_weights: Annotated[Array, "C"]
    border_px: Annotated[Array, "C"]
    border_weights: Annotated[Array, "C"]
    jacobian: Annotated[Array, "C 7"]
    joint_jacobian: Annotated[Array, "C _"]
    camera_jacobian: Annotated[Array, "C 6"]
    normals: Annotated[Array, "C 2"]

    __post_init__ = freeze_arrays


def collect_evidence(
    S: Array, views: list[AlignmentImage], drawing: RobotDrawing, contour_points: int
) -> list[ViewEvidence]:
    """Collect the evidence of every view that shows enough of the robot."""
    found = []
    for number, view in enumerate(views):
        drawn = drawing.draw(camera_in_world(S, view.camera_recon), contour_points)
        if drawn is not None:
            found.append(_evidence(S, number, view, drawn, drawing.configuration))
    return found


def _evidence(
    S: Array, number: int, view: AlignmentImage, drawn: RenderedRobot, configuration: RobotConfiguration
) -> ViewEvidence:
    camera = camera_in_world(S, view.camera_recon)
    gray = luma_from_srgb(view.image_srgb)
    contour, mask, bodies = drawn
    edges, strength = edge_shifts(contour, gray, REACH_PX)
    ratio = color_ratio(view.image_srgb, mask, 2 * BORDER_REACH_PX)
    borders, border_sds = region_shifts(contour, ratio, BORDER_REACH_PX)
    aside, mask_aside = _move_aside(contour, mask, number)
    size = np.array([camera.width, camera.height])
    inside = np.all((aside.pixels > 3) & (aside.pixels < size - 3), axis=1)
    gradient = shift_gradient(camera, contour)
    turns = configuration.turns(contour.points, bodies)
    return ViewEvidence(
        name=view.name,
        segments=configuration.segments()[bodies],
        confirmed=_find_confirmed(contour, mask, view, gray),
        by_chance=_find_confirmed(aside, mask_aside, view, gray)[inside],
        edge_px=edges,
        edge_weights=EDGE_KERNEL.weights(edges) / edge_sds(strength) ** 2,
        border_px=borders,
        border_weights=border_kernel(BORDER_REACH_PX).weights(borders) / border_sds**2,
        jacobian=shift_jacobian(camera, contour, configuration.ee_world),
        joint_jacobian=np.einsum("cd,cjd->cj", gradient, turns),
        camera_jacobian=np.asarray(
            np.concatenate([gradient, np.cross(contour.points - camera.center, gradient)], axis=1), np.float64
        ),
        normals=contour.normals,
    )


def _find_confirmed(
    contour: Contour, mask: NDArray[np.bool_], view: AlignmentImage, gray: NDArray[np.float32]
) -> NDArray[np.bool_]:
    edge, strength = edge_shifts(contour, gray, REACH_PX)
    border, _ = region_shifts(contour, color_ratio(view.image_srgb, mask, 2 * REACH_PX), REACH_PX)
    return (np.abs(edge) <= NEAR_EDGE_PX) & (strength > MIN_STEP) & (np.abs(border) <= NEAR_BORDER_PX)


def _move_aside(contour: Contour, mask: NDArray[np.bool_], number: int) -> tuple[Contour, NDArray[np.bool_]]:
    """Shift an outline and its silhouette (H, W); the direction of the shift differs between views."""
    golden = number * np.pi * (3 - np.sqrt(5))
    shift = np.round(ASIDE * mask.shape[1] * np.array([np.cos(golden), np.sin(golden)]))
    moved = replace(contour, pixels=contour.pixels + shift)
    return moved, np.roll(mask, (int(shift[1]), int(shift[0])), (0, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmation:
    """Shares of outline points that the images confirm.

    Attributes:
        support: Confirmed share of all points, 0..1.
        chance: Confirmed share of the shifted outlines, 0..1.
        lift_of_segment: Support beyond chance divided by one minus chance, for every segment of the arm (number of
            joints that move it) with enough points.
    """

    support: float
    chance: float
    lift_of_segment: dict[int, float]

    @property
    def lift(self) -> float:
        """Support of the whole robot beyond chance; 0 is the support by clutter, 1 is full support."""
        return (self.support - self.chance) / (1 - self.chance)


def confirmation(evidence: list[ViewEvidence]) -> Confirmation:
    """Pool the evidence of all views; without evidence the support is zero."""
    if not evidence:
        return Confirmation(support=0.0, chance=0.0, lift_of_segment={})
    confirmed = np.concatenate([view.confirmed for view in evidence])
    segments = np.concatenate([view.segments for view in evidence])
    by_chance = np.concatenate([view.by_chance for view in evidence])
    chance = min(float(by_chance.mean()) if len(by_chance) else 0.0, 0.9)
    lifts = {
        int(segment): (float(confirmed[segments == segment].mean()) - chance) / (1 - chance)
        for segment in np.unique(segments)
        if np.sum(segments == segment) >= MIN_SEGMENT_POINTS
    }
    return Confirmation(support=float(confirmed.mean()), chance=chance, lift_of_segment=lifts)


def find_wrist_rotation(
    S: Array,
    views: list[AlignmentImage],
    drawing: RobotDrawing,
    contour_points: int,
    logged: list[ViewEvidence],
) -> tuple[float, float] | None:
    """Find a rotation of the last joint that the images confirm clearly better than the logged one.

    The gripper is rendered at several rotations, and the confirmed shares of its contour are compared.

    Args:
        drawing: Renders the robot at its logged joint values.
        logged: Evidence for the logged joint values, from these views and possibly others.

    Returns:
        The rotation relative to the log, [rad], and the gain in the confirmed share; None if the images do
        not contradict the log, or if the last joint is prismatic.
    """
    if drawing.configuration.robot.slides[-1]:
        return None
    gripper = len(drawing.configuration.joints)
    names = {view.name for view in views}

    def confirm(evidence: list[ViewEvidence]) -> tuple[float, int]:
        seen = [view.confirmed[view.segments == gripper] for view in evidence if view.name in names]
        points = np.concatenate(seen) if seen else np.zeros(0, np.bool_)
        return (float(points.mean()), len(points)) if len(points) else (0.0, 0)

    def turn(turn_deg: float) -> RobotDrawing:
        joints = drawing.configuration.joints.copy()
        joints[-1] += np.radians(turn_deg)
        return replace(drawing, configuration=replace(drawing.configuration, joints=joints))

    own, count = confirm(logged)
    shares = [confirm(collect_evidence(S, views, turn(angle), contour_points))[0] for angle in TURNS_DEG]
    best = int(np.argmax(shares))
    if count == 0:
        return None
    gain = shares[best] - own
    variance = (own * (1 - own) + shares[best] * (1 - shares[best])) * CORRELATED_POINTS / count
    clear = gain > 0 and gain > CLEAR_SDS * np.sqrt(variance)
    return (float(np.radians(TURNS_DEG[best])), gain) if clear else None
