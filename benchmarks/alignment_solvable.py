"""Test whether a start of the alignment has a solution: a question of geometry, independent of any method."""

import numpy as np

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.starting_poses import RobotBox
from aomgen.core.camera import camera_in_world
from aomgen.core.values import Array
from aomgen.robots.robot import RobotConfiguration

MIN_VIEWS, MIN_ANGLE_DEG = 6, 30.0


def is_solvable(
    views: list[AlignmentImage],
    boxes: list[RobotBox],
    configuration: RobotConfiguration,
    S_world_recon: Array,
) -> bool:
    """Return whether images and prompts determine the solution, whatever the method.

    Half of the robot or more is in at least `MIN_VIEWS` images, two of them from directions
    `MIN_ANGLE_DEG` apart, which determines location and scale to the pixel; and one prompted box overlaps
    with the robot's true extent in its image by at least half (intersection over union).
    Cameras may have errors that the end effector's tolerance allows. Not checked: obstacles
    before the robot.
    """
    points = configuration.points_world(300)
    directions, overlaps = [], []
    for view in views:
        camera = camera_in_world(S_world_recon, view.camera_recon)
        pixels, z = camera.project(points)
        inside = (z > 0) & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1)
        if inside.mean() >= 0.5:
            arm = camera.center - points.mean(0)
            directions.append(arm / np.linalg.norm(arm))
    for box in boxes:
        camera = camera_in_world(S_world_recon, box.camera_recon)
        pixels, z = camera.project(points)
        seen = np.clip(pixels[z > 0], 0, [camera.width, camera.height])
        overlaps.append(_overlap(box.box_px, np.concatenate([seen.min(0), seen.max(0)])))
    cosines = np.array(directions) @ np.array(directions).T if directions else np.ones((1, 1))
    wide = cosines.min() <= np.cos(np.radians(MIN_ANGLE_DEG))
    return len(directions) >= MIN_VIEWS and bool(wide) and max(overlaps, default=0.0) >= 0.5


def _overlap(a: Array, b: Array) -> float:
    """Compute the intersection over union of two boxes (4,)."""
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    common = float(np.prod(np.maximum(sides, 0)))
    return common / float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - common)
