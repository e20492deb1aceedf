"""The robot's surface sharpened against the pictures, in every posture that they show."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.gaussians import concatenate
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.physics.robot import RobotModel
from aomgen.reconstruction.robot_views import Film
from aomgen.splatting.refining import Lesson, RefiningParams, refined
from aomgen.twin.relit import Relit, surfaces_of
from aomgen.twin.twin import Twin, body_poses

# Discs move this much in a step, [px] of the usual picture.
STEP_PX: Final = 0.1
# Around the robot, so that its outline is judged against what is behind, [px].
MARGIN_PX: Final = 24
# Smaller views of the robot tell nothing and are less than the structural loss looks at, [px].
MIN_SIDE_PX: Final = 32


def sharpened(
    twin: Twin, robot: RobotModel, films: Sequence[Film], pixel_m: float, rng: np.random.Generator
) -> Twin:
    """The twin with its relit discs fitted to pictures.

    Shape and glare are the same in all postures. Colors, beyond what `robot_colors` found, are
    learned for the orientations of the scan, and come back as much as memories of them do.

    Args:
        twin: Its relit Gaussians are its last ones.
        robot: Its robot.
        films: What to fit to.
        pixel_m: Size of a pixel at the robot in the usual picture, [m].
        rng: Order of the pictures.
    """
    relit = twin.relit
    if relit is None:
        return twin
    lessons = _lessons(twin, relit, robot, films)
    if not lessons:
        return twin
    count = len(twin.gaussians) - len(relit.indices)
    still, free = twin.gaussians.select(np.arange(count)), twin.gaussians.select(relit.indices)
    params = RefiningParams(rate_means=STEP_PX * pixel_m)
    discs, difference = refined(still, free, twin.bodies, lessons, params, rng)
    return replace(
        twin,
        gaussians=concatenate([still, discs]),
        relit=_corrected(relit, twin, robot, difference),
    )


def _lessons(twin: Twin, relit: Relit, robot: RobotModel, films: Sequence[Film]) -> list[Lesson]:
    surfaces = surfaces_of(relit, twin.bodies)
    scan_orientations = _scan_orientations(relit, twin, robot)
    means, owners = twin.gaussians.means[relit.indices], twin.bodies[relit.indices]
    lessons = []
    for film in films:
        for image, state in zip(film.images_srgb, film.states, strict=True):
            Ts = body_poses(twin, robot, state)
            window = _window(film.camera, apply(Ts[owners], means))
            if window is None:
                continue
            camera, rows, columns = window
            colors, recall = np.zeros((len(means), 3)), np.zeros(len(means))
            for surface in surfaces:
                R = Ts[surface.body, :3, :3]
                colors[surface.rows] = surface.colors_srgb(R)
                if surface.remembered is not None:
                    recall[surface.rows] = surface.remembered.weights(R)[scan_orientations[surface.body]]
            lessons.append(
                Lesson(
                    camera=camera,
                    image_srgb=image[rows, columns],
                    Ts_world_part=Ts,
                    colors_srgb=colors,
                    recall=recall,
                )
            )
    return lessons


def _scan_orientations(relit: Relit, twin: Twin, robot: RobotModel) -> dict[int, int]:
    """Which remembered orientation of every body is nearest to the scan's."""
    Ts = body_poses(twin, robot, twin.scan_state)
    return {
        item.body: int(np.argmax(np.einsum("kij,ij->k", item.Rs_world_body, Ts[item.body, :3, :3])))
        for item in relit.remembered
    }


def _corrected(relit: Relit, twin: Twin, robot: RobotModel, difference: Array) -> Relit:
    """Memories of the scan's orientations with differences in color (M, 3) added."""
    which = _scan_orientations(relit, twin, robot)
    remembered = []
    for item in relit.remembered:
        colors = np.array(item.difference_srgb)
        colors[which[item.body]] += difference[item.rows]
        remembered.append(replace(item, difference_srgb=colors))
    return replace(relit, remembered=tuple(remembered))


def _window(camera: Camera, points_world: Array) -> tuple[Camera, slice, slice] | None:
    """The camera of the part of the image around points (N, 3), and that part; None where it is small."""
    pixels, depths = camera.project(points_world)
    pixels = pixels[depths > 0]
    if not len(pixels):
        return None
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(0)) - MARGIN_PX, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + MARGIN_PX, 0, size).astype(int)
    if (high - low < MIN_SIDE_PX).any():
        return None
    width, height = (int(side) for side in high - low)
    part = replace(camera, cx=camera.cx - low[0], cy=camera.cy - low[1], width=width, height=height)
    return part, slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
