"""Fit of the rendered robot to its contours in many images, all views at once.

Gauss-Newton over the seven parameters of a similarity; see `contours` for the residuals.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import (
    AlignmentImage,
    Contour,
    color_ratio,
    edge_shifts,
    outline,
    region_shifts,
    shift_jacobian,
)
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.transforms import matrix_from_rotvec, similarity
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.robots.configuration import RobotConfiguration
from aomgen.robots.silhouette import SilhouetteRenderer


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One setting of the refinement.

    Attributes:
        width: Image width, [px].
        reach: How far across the outline is searched, [px].
        draws: How often the robot is rendered again.
        steps: Gauss-Newton steps on one rendering; the outline's points move with the robot.
        edges: Pull to image edges; else to the border between two colors.
        fine: Render the finer meshes.
    """

    width: int
    reach: int
    draws: int
    steps: int
    edges: bool = False
    fine: bool = False


MIDDLE = (
    Level(width=320, reach=12, draws=2, steps=2),
    Level(width=640, reach=8, draws=1, steps=2),
)
FINE = (Level(width=640, reach=4, draws=3, steps=3, edges=True, fine=True),)
# Cells of the meshes that are drawn coarsely: a pixel of a small image sees as much at two metres.
COARSE_CELL_M = 0.006
# Steps shorter than this change no digit that is reported.
CONVERGED_M, CONVERGED_RAD = 5e-5, 5e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedRobot:
    """A rendered robot: its outline, its silhouette, and the body (C,) at each outline point."""

    contour: Contour
    mask: NDArray[np.bool_]
    bodies: NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDrawing:
    """The posed robot with renderers of its fine and coarse meshes.

    Attributes:
        fine, coarse: Renderers of the same robot.
        configuration: Its joint values.
        pivot: Point (3,) that the robot's motions turn about, [m].
        segments, joint_motions: See `RobotConfiguration`.
    """

    fine: SilhouetteRenderer
    coarse: SilhouetteRenderer
    configuration: RobotConfiguration
    pivot: Array
    segments: NDArray[np.int64]
    joint_motions: Array

    def draw(self, camera: Camera, limit: int, *, fine: bool = True) -> RenderedRobot | None:
        """The robot in one image, or None when too little of it, or nothing else, is there."""
        renderer = self.fine if fine else self.coarse
        bodies, depth = renderer.draw(camera, self.configuration.joints, self.configuration.gripper)
        mask = bodies >= 0
        if not 0.002 < mask.mean() < 0.7:
            return None
        contour = outline(camera, mask, depth, limit)
        if len(contour.pixels) < 20:
            return None
        column, row = np.floor(contour.pixels - 0.5 * contour.normals).astype(int).T
        return RenderedRobot(contour=contour, mask=mask, bodies=bodies[row, column])


@contextmanager
def robot_drawing(configuration: RobotConfiguration, width: int, height: int) -> Iterator[RobotDrawing]:
    """A drawing for images up to a size [px]; holds two OpenGL contexts."""
    limits = {"max_width": width, "max_height": height}
    with (
        SilhouetteRenderer(configuration.robot, **limits) as fine,
        SilhouetteRenderer(configuration.robot, **limits, cell_m=COARSE_CELL_M) as coarse,
    ):
        yield RobotDrawing(
            fine=fine,
            coarse=coarse,
            configuration=configuration,
            pivot=configuration.points_world().mean(0),
            segments=configuration.segments(),
            joint_motions=configuration.joint_motions(),
        )


def refine(
    S: Array,
    views: list[AlignmentImage],
    drawing: RobotDrawing,
    levels: tuple[Level, ...],
    contour_points: int,
) -> Array:
    """Refine a similarity until the rendered contours fit those of the images."""
    for level in levels:
        resized = [limit_width(view, level.width) for view in views]
        grays = [gray_levels(view.image_srgb) for view in resized]
        for _ in range(level.draws):
            lines = [
                line
                for view, gray in zip(resized, grays, strict=True)
                if (line := _lines(S, view, gray, drawing, level, contour_points))
            ]
            S, converged = _descend(S, lines, drawing, level)
            if converged:
                break
    return S


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lines:
    """Search lines of one view across its rendered contour."""

    view: AlignmentImage
    contour: Contour
    field: NDArray[np.float32]


def _lines(
    S: Array, view: AlignmentImage, gray: NDArray[np.float32], drawing: RobotDrawing, level: Level, limit: int
) -> _Lines | None:
    drawn = drawing.draw(camera_in_world(S, view.camera_recon), limit, fine=level.fine)
    if drawn is None:
        return None
    field = gray if level.edges else color_ratio(view.image_srgb, drawn.mask, 2 * level.reach)
    return _Lines(view=view, contour=drawn.contour, field=field)


def _descend(S: Array, lines: list[_Lines], drawing: RobotDrawing, level: Level) -> tuple[Array, bool]:
    """Take Gauss-Newton steps on one set of renderings; also returns whether the first was negligible."""
    for number in range(level.steps):
        A, b = np.zeros((7, 7)), np.zeros(7)
        for line in lines:
            camera = camera_in_world(S, line.view.camera_recon)
            J, shifts, weights = _pull(line, camera, drawing.pivot, level)
            A += J.T @ (weights[:, None] * J)
            b += J.T @ (weights * shifts)
        step = np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(7) + 1e-9 * np.eye(7), b)
        S = move_similarity(S, step, drawing.pivot)
        if np.linalg.norm(step[3:6]) < CONVERGED_M and np.linalg.norm(step[:3]) < CONVERGED_RAD:
            return S, number == 0
    return S, False


def _pull(line: _Lines, camera: Camera, pivot: Array, level: Level) -> tuple[Array, Array, Array]:
    """Jacobian (C, 7), shifts (C,) [px] and weights (C,) of one view."""
    contour = line.contour.seen_by(camera)
    if level.edges:
        shifts, strength = edge_shifts(contour, line.field, level.reach)
        weights = edge_weights(shifts, strength)
    else:
        shifts, variances = region_shifts(contour, line.field, level.reach)
        weights = region_weights(shifts, variances, level.reach)
    return shift_jacobian(camera, contour, pivot), shifts, weights


def edge_weights(shifts: Array, strength: Array) -> Array:
    """Weights (C,) of shifts to edges [px] of a strength; edges farther than a pixel fade."""
    return np.minimum(strength / 0.05, 1.0) / (1 + shifts**2) ** 2


def region_weights(shifts: Array, variances: Array, reach: int) -> Array:
    """Weights (C,) of shifts to color borders [px] of a variance."""
    return 1 / (variances + 0.5) / (1 + (shifts / (0.5 * reach)) ** 2)


def move_similarity(S: Array, step: Array, pivot: Array) -> Array:
    """Update a similarity by a `step` (7,) of the robot from its rendered pose."""
    step = np.concatenate([np.clip(step[:6], -0.2, 0.2), np.clip(step[6:], -0.15, 0.15)])
    scale, R = float(np.exp(step[6])), matrix_from_rotvec(step[:3])
    D = similarity(scale, R, pivot + step[3:6] - scale * R @ pivot)
    return np.linalg.inv(D) @ S


def spread(views: list[AlignmentImage], S: Array, drawing: RobotDrawing, count: int) -> list[AlignmentImage]:
    """Views that show the robot well, chosen far from one another by viewing direction."""
    robot = drawing.configuration.points_world(300)
    target = robot.mean(0)
    usable, directions = [], []
    for view in views:
        camera = camera_in_world(S, view.camera_recon)
        pixels, depths = camera.project(robot)
        size = np.array([camera.width, camera.height])
        inside = (depths > 0.05) & np.all((pixels > 0) & (pixels < size), 1)
        if inside.mean() > 0.3 and np.prod(np.ptp(pixels[inside], axis=0)) > 0.02 * np.prod(size):
            offset = camera.center - target
            usable.append(view)
            directions.append(offset / np.linalg.norm(offset))
    if len(usable) <= count:
        return usable
    points = np.array(directions)
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return [usable[i] for i in sorted(chosen)]


def limit_width(view: AlignmentImage, width: int) -> AlignmentImage:
    """Reduce a view to at most `width` pixels."""
    return scale_image(view, min(1.0, width / view.camera_recon.width))


def scale_image(view: AlignmentImage, scale: float) -> AlignmentImage:
    if scale == 1.0:
        return view
    width = round(view.camera_recon.width * scale)
    height = round(view.camera_recon.height * scale)
    return AlignmentImage(
        name=view.name,
        camera_recon=view.camera_recon.resized(width, height),
        image_srgb=resize(view.image_srgb, width, height),
    )


def gray_levels(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    gray = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return (gray / 255).astype(np.float32)
