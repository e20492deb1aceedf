"""Fit of the rendered robot to its contours in many images, all views at once; see `contours` for the residuals."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.contours import (
    AlignmentImage,
    Contour,
    border_kernel,
    color_ratio,
    edge_sds,
    edge_shifts,
    outline,
    region_shifts,
    shift_jacobian,
)
from aomgen.conventions import luma_from_srgb
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.least_squares import Kernel, ResidualTerm, solve
from aomgen.core.transforms import matrix_from_rotvec, similarity
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.robots.robot import RobotConfiguration
from aomgen.robots.silhouette import SilhouetteRenderer

# Least and largest share of the image that the robot covers: a smaller one has too little signal, a larger one no contour.
_SHARES = (0.002, 0.7)
# Least number of contour points that determine six degrees of freedom.
_MIN_POINTS = 20
# Cell size of the coarse meshes, [m]: the size of a pixel of a small image at a distance of two meters.
COARSE_CELL_M = 0.006
# Scale of the robust kernel of edges, [px]: edges at a larger distance have less weight.
EDGE_KERNEL = Kernel(scale=1.0)
# Number of steps on one rendering: its points move with the robot, which is valid for a few pixels.
_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One setting of the fit.

    Attributes:
        width: Image width, [px].
        reach: Search range across the outline, [px].
        draws: Number of times that the robot is rendered again.
        fine: Render the finer meshes and fit to image edges; otherwise to the border between two colors.
    """

    width: int
    reach: int
    draws: int
    fine: bool = False


MIDDLE = (Level(width=320, reach=12, draws=2), Level(width=640, reach=8, draws=1))
FINE = (Level(width=640, reach=4, draws=3, fine=True),)


# A rendered robot: outline of C points, silhouette (H, W), and body (C,) at each outline point.
RenderedRobot = tuple[Contour, NDArray[np.bool_], NDArray[np.int32]]


def render_robot(
    renderer: SilhouetteRenderer, configuration: RobotConfiguration, camera: Camera, limit: int
) -> RenderedRobot | None:
    """Render the robot with at most `limit` outline points; None if it covers too little or too much of the image."""
    bodies, depth = renderer.draw(camera, configuration.joints, configuration.gripper)
    mask = bodies >= 0
    if not _SHARES[0] < mask.mean() < _SHARES[1]:
        return None
    contour = outline(camera, mask, depth, limit)
    if len(contour.pixels) < _MIN_POINTS:
        return None
    # The outline is half a pixel outside the pixels on which it was found.
    column, row = np.floor(contour.pixels - 0.5 * contour.normals).astype(int).T
    return contour, mask, bodies[row, column]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDrawing:
    """The posed robot with renderers of its fine and coarse meshes; its motions turn about `pivot` (3,), [m]."""

    fine: SilhouetteRenderer
    coarse: SilhouetteRenderer
    configuration: RobotConfiguration
    pivot: Array

    def draw(self, camera: Camera, limit: int, *, fine: bool = True) -> RenderedRobot | None:
        """Render the robot in one image, see `render_robot`."""
        return render_robot(self.fine if fine else self.coarse, self.configuration, camera, limit)


@contextmanager
def robot_drawing(configuration: RobotConfiguration, width: int, height: int) -> Iterator[RobotDrawing]:
    """Open the renderers for images up to a size [px]; they hold two OpenGL contexts."""
    limits = {"max_width": width, "max_height": height}
    with (
        SilhouetteRenderer(configuration.robot, **limits) as fine,
        SilhouetteRenderer(configuration.robot, **limits, cell_m=COARSE_CELL_M) as coarse,
    ):
        yield RobotDrawing(
            fine=fine, coarse=coarse, configuration=configuration, pivot=configuration.points_world().mean(0)
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
        for _ in range(level.draws):
            term = _contour_term(S, resized, drawing, level, contour_points)
            if term is not None:
                S = solve(
                    [term],
                    S,
                    retract=lambda S, step: move_similarity(S, step, drawing.pivot),
                    dimension=7,
                    max_iterations=_STEPS,
                ).state
    return S


def _contour_term(
    S: Array, views: list[AlignmentImage], drawing: RobotDrawing, level: Level, limit: int
) -> ResidualTerm[Array] | None:
    """Render contours once, and return the term of their shifts [px] to the images; None if no view shows the robot."""
    lines: list[tuple[Camera, Contour, NDArray[np.float32]]] = []
    for view in views:
        drawn = drawing.draw(camera_in_world(S, view.camera_recon), limit, fine=level.fine)
        if drawn is not None:
            contour, mask, _ = drawn
            image = view.image_srgb
            field = luma_from_srgb(image) if level.fine else color_ratio(image, mask, 2 * level.reach)
            lines.append((view.camera_recon, contour, field))
    if not lines:
        return None

    def search(S: Array) -> tuple[Array, Array]:
        find = edge_shifts if level.fine else region_shifts
        found = [find(_seen(contour, S, camera), field, level.reach) for camera, contour, field in lines]
        shifts, certainty = (np.concatenate(part) for part in zip(*found, strict=True))
        return shifts, certainty

    def jacobian(S: Array) -> Array:
        return -np.concatenate(
            [
                shift_jacobian(camera_in_world(S, camera), _seen(contour, S, camera), drawing.pivot)
                for camera, contour, _ in lines
            ]
        )

    _, certainty = search(S)
    return ResidualTerm(
        name="contours",
        residual=lambda S: search(S)[0],
        sd=edge_sds(certainty) if level.fine else certainty,
        kernel=EDGE_KERNEL if level.fine else border_kernel(level.reach),
        jacobian=jacobian,
    )


def _seen(contour: Contour, S: Array, camera_recon: Camera) -> Contour:
    return contour.move(contour.points, camera_in_world(S, camera_recon))


def move_similarity(S: Array, step: Array, pivot: Array) -> Array:
    """Update a similarity by a `step` (7,) of the robot from its rendered pose."""
    step = np.concatenate([np.clip(step[:6], -0.2, 0.2), np.clip(step[6:], -0.15, 0.15)])
    scale, R = float(np.exp(step[6])), matrix_from_rotvec(step[:3])
    D = similarity(scale, R, pivot + step[3:6] - scale * R @ pivot)
    return np.asarray(np.linalg.inv(D) @ S, np.float64)


def spread(views: list[AlignmentImage], S: Array, drawing: RobotDrawing, count: int) -> list[AlignmentImage]:
    """Select views that show the robot well, with viewing directions far from one another."""
    robot = drawing.configuration.points_world(300)
    usable = []
    for view in views:
        camera = camera_in_world(S, view.camera_recon)
        pixels, depths = camera.project(robot)
        size = np.array([camera.width, camera.height])
        inside = (depths > 0.05) & np.all((pixels > 0) & (pixels < size), 1)
        if inside.mean() > 0.3 and np.prod(np.ptp(pixels[inside], axis=0)) > 0.02 * np.prod(size):
            usable.append(view)
    centers = [camera_in_world(S, view.camera_recon).center for view in usable]
    return [usable[i] for i in sorted(far_apart(centers, robot.mean(0), count))]


def far_apart(centers: list[Array], target: Array, count: int) -> list[int]:
    """Select at most `count` camera centers (N, 3): each next one is the farthest in direction from all selected."""
    if len(centers) <= count:
        return list(range(len(centers)))
    sides = np.array(centers) - target
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    chosen, distances = [0], np.linalg.norm(sides - sides[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(sides - sides[chosen[-1]], axis=1))
    return chosen


def limit_width(view: AlignmentImage, width: int) -> AlignmentImage:
    """Reduce a view to at most `width` pixels."""
    if view.camera_recon.width <= width:
        return view
    camera = view.camera_recon.narrow(width)
    image = resize(view.image_srgb, camera.width, camera.height)
    return replace(view, camera_recon=camera, image_srgb=image)
