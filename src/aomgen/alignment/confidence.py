"""Confirmation of rendered contours by image edges and colors, and the shifts that would fit better.

A share of confirmed points means little by itself: clutter confirms contours that lie anywhere. So
each contour is also moved aside in its own image; what is confirmed there estimates chance. The rotation of the
last joint hardly moves the contour of anything but the gripper, which then leaves the search reach, and part of
whose contour is confirmed by chance; so other rotations are rendered, too.
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
from aomgen.alignment.silhouette_fit import (
    EDGE_KERNEL,
    RenderedRobot,
    RobotDrawing,
)
from aomgen.conventions import luma_from_srgb
from aomgen.core.camera import camera_in_world
from aomgen.core.values import Array, freeze_arrays

# A point is confirmed by an edge this near and this strong, and by a color border this near.
NEAR_EDGE_PX, MIN_STEP, NEAR_BORDER_PX = 2.0, 0.02, 3.0
REACH_PX, BORDER_REACH_PX = 8, 16
# Outlines are moved aside by this share of the image's width: far beyond the reach, near enough
# to cross the same surroundings.
ASIDE = 0.06
# Beyond the reach of edges, and close enough together that one of them is near any turn. A parallel
# gripper looks alike after half a turn.
TURNS_DEG = (-60.0, -30.0, -15.0, 15.0, 30.0, 60.0, 90.0)
# Standard deviations by which a rotated wrist must fit better, so that chance does not report one.
CLEAR_SDS = 3.0
# Segments with fewer contour points are not judged; ten neighbours count as one.
MIN_SEGMENT_POINTS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEvidence:
    """Evidence of one image for the contour rendered into it; C points, J arm joints.

    Attributes:
        segments: Number (C,) of arm joints that move the body at each point.
        by_chance: (D,) bool, the same for those points that stay in the image moved aside.
        edge_px, edge_weights: Signed shift outwards to the image's edge (C,), and its weight.
        border_px, border_weights: The same for the border between two colors, farther reaching.
        jacobian: (C, 7), see `shift_jacobian`, about the end effector.
        joint_jacobian: (C, J), shift of the outline for a turn of each joint, [px/rad].
        camera_jacobian: (C, 6), the shift that an error of the camera looks like: centre [m], then
            rotation vector [rad], world frame.
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
            found.append(_evidence(S, number, view, drawn, drawing))
    return found


def _evidence(
    S: Array, number: int, view: AlignmentImage, drawn: RenderedRobot, drawing: RobotDrawing
) -> ViewEvidence:
    camera = camera_in_world(S, view.camera_recon)
    gray = luma_from_srgb(view.image_srgb)
    contour = drawn.contour
    edges, strength = edge_shifts(contour, gray, REACH_PX)
    ratio = color_ratio(view.image_srgb, drawn.mask, 2 * BORDER_REACH_PX)
    borders, border_sds = region_shifts(contour, ratio, BORDER_REACH_PX)
    aside = _move_aside(drawn, number, camera.width)
    size = np.array([camera.width, camera.height])
    inside = np.all((aside.contour.pixels > 3) & (aside.contour.pixels < size - 3), axis=1)
    gradient = shift_gradient(camera, contour)
    turns = drawing.configuration.turns(contour.points, drawn.bodies)
    return ViewEvidence(
        name=view.name,
        segments=drawing.configuration.segments()[drawn.bodies],
        confirmed=_find_confirmed(contour, drawn.mask, view, gray),
        by_chance=_find_confirmed(aside.contour, aside.mask, view, gray)[inside],
        edge_px=edges,
        edge_weights=EDGE_KERNEL.weights(edges) / edge_sds(strength) ** 2,
        border_px=borders,
        border_weights=border_kernel(BORDER_REACH_PX).weights(borders) / border_sds**2,
        jacobian=shift_jacobian(camera, contour, drawing.configuration.ee_world),
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


def _move_aside(drawn: RenderedRobot, number: int, width: int) -> RenderedRobot:
    """The same outline elsewhere in the image; directions differ from view to view."""
    golden = number * np.pi * (3 - np.sqrt(5))
    shift = np.round(ASIDE * width * np.array([np.cos(golden), np.sin(golden)]))
    contour = replace(drawn.contour, pixels=drawn.contour.pixels + shift)
    mask = np.roll(drawn.mask, (int(shift[1]), int(shift[0])), (0, 1))
    return replace(drawn, contour=contour, mask=mask)


@dataclass(frozen=True, slots=True, kw_only=True)
class Confirmation:
    """Shares of outline points that images confirm.

    Attributes:
        support: Of all points, 0..1.
        chance: Of the outlines moved aside, 0..1.
        lift_of_segment: Support beyond chance, as share of what was left to confirm, for every
            segment of the arm (number of joints that move it) with enough points.
    """

    support: float
    chance: float
    lift_of_segment: dict[int, float]

    @property
    def lift(self) -> float:
        """Support of the whole robot beyond chance, 0 = as clutter would, 1 = everything."""
        return (self.support - self.chance) / (1 - self.chance)


def confirmation(evidence: list[ViewEvidence]) -> Confirmation:
    """Pool the evidence of all views; nothing is confirmed where there is none."""
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
        drawing: Draws the robot as logged.
        logged: Evidence for the robot as logged; of these views and perhaps more.

    Returns:
        The rotation relative to the log, [rad], and the gain in the confirmed share; None where the images do
        not contradict the log.

    Not checked: the last joint turns (one that slides finds no better turn).
    """
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
