"""The pictures of a capture with the state of the twin in each: what its looks are learned from."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aomgen.appearance.directional_light import found_lamp, without_shadow
from aomgen.appearance.refine import sharpened
from aomgen.appearance.robot_surfels import dressed
from aomgen.appearance.surfel_observations import Film, matched_film
from aomgen.capture.check import read_demo_videos
from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera
from aomgen.core.held_out import held_out
from aomgen.core.motion import MotionEstimate
from aomgen.core.progress import Progress
from aomgen.core.recording import Capture
from aomgen.errors import ReconstructionError
from aomgen.io.images import read_image
from aomgen.replacement.support import find_support
from aomgen.robots.robot import RobotModel
from aomgen.twin.directional_shadow import DirectionalLight
from aomgen.twin.twin import Twin, TwinState, posed, render_state

# More pictures tell little more, and take as long again.
SCAN_PICTURES = 80
# Pictures of the video for each of the scan: more of one place make all others worse. But the whole
# motion has to be seen.
DEMO_SHARE = 0.5
# Fewer frames skip parts of the motion.
MIN_DEMO_PICTURES = 16


def scan_films(capture: Capture, cameras_world: dict[str, Camera], twin: Twin) -> list[Film]:
    """Scan images that are not held out, evenly chosen."""
    withheld = set(held_out([path.name for path in capture.scan_images]))
    usable = [p for p in capture.scan_images if p.name in cameras_world and p.name not in withheld]
    chosen = np.unique(np.linspace(0, max(len(usable) - 1, 0), SCAN_PICTURES).astype(int))
    return [
        Film(
            camera=cameras_world[usable[i].name],
            images_srgb=(read_image(usable[i]),),
            states=(twin.scan_state,),
        )
        for i in chosen[: len(usable)]
    ]


def fitted_frames(capture: Capture, frames: int) -> NDArray[np.int64]:
    """Which of the first fixed camera's frames the twin is fitted to; the others stay unseen."""
    count = max(int(DEMO_SHARE * min(len(capture.scan_images), SCAN_PICTURES)), MIN_DEMO_PICTURES)
    return np.unique(np.linspace(0, frames - 1, count).astype(np.int64))


def demo_film(
    capture: Capture, camera_world: Camera, motion: MotionEstimate, twin: Twin, robot: RobotModel
) -> Film:
    """The first fixed camera's video, as the scan would have exposed it, evenly chosen."""
    video = read_demo_videos(capture)[capture.cameras[0].name]
    chosen = fitted_frames(capture, len(video.times_s))
    times = video.times_s[chosen]
    joints, gripper = capture.joint_log.at(times + motion.clock_offset_s)
    states = tuple(
        TwinState(joints=q, gripper=float(g), theta=float(theta), T_world_object=twin.T_world_object)
        for q, g, theta in zip(joints, gripper, motion.theta_at(times), strict=True)
    )
    film = Film(camera=camera_world, images_srgb=tuple(video.frames_srgb[i] for i in chosen), states=states)
    first = render_state(twin, robot, states[0], camera_world, features=(~twin.moves)[:, None] * 1.0)
    return matched_film(film, np.asarray(first.rgb, np.float64), np.asarray(first.features)[..., 0] > 0.95)


def with_looks(twin: Twin, robot: RobotModel, films: Sequence[Film], progress: Progress) -> Twin:
    """The twin as all pictures show it.

    Its robot is dressed in the model's surface, shadows that move are told from the surface they fall
    on, then everything is fitted.

    Args:
        twin: The scan bound to its bodies.
        robot: Its robot.
        films: Of the scan, and last of a fixed camera.
        progress: Told how far it has come.
    """
    rng = np.random.default_rng(0)
    progress(0.1, "the robot's surface")
    clad = dressed(twin, robot, films, rng)
    progress(0.3, "the lamp that throws its shadow")
    lamp = _lamp(clad, robot, films[-1])
    lit = clad if lamp is None else without_shadow(clad, robot, lamp)
    progress(0.4, "pictures in every posture")
    return sharpened(lit, robot, films, rng)


def _lamp(twin: Twin, robot: RobotModel, film: Film) -> DirectionalLight | None:
    """The lamp that throws shadows on what the object stands on; None when there is none or it stands on nothing."""
    world = posed(twin, robot, twin.scan_state)
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    scene = (twin.labels == BACKGROUND) & (twin.bodies == 0)
    try:
        support = find_support(
            world.means[of_object], world.opacities[of_object], world.select(scene), twin.T_world_object
        )
    except ReconstructionError:
        return None
    return found_lamp(twin, robot, film, support.T_world_plane)
