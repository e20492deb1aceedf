"""The images of a capture with the twin's state in each, and the appearance that is fitted to them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aomgen.appearance.directional_light import find_directional_light, remove_baked_shadow
from aomgen.appearance.refine import refine_twin
from aomgen.appearance.robot_surfels import replace_robot_gaussians
from aomgen.appearance.surfel_observations import PosedImages, match_exposure
from aomgen.capture.capture_check import read_demo_videos
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

# More images tell little more, and take as long again.
MAX_SCAN_IMAGES = 80
# Frames of the video for each image of the scan: more from one place make all other views worse.
DEMO_SHARE = 0.5
# Fewer frames skip parts of the motion.
MIN_DEMO_FRAMES = 16


def pose_scan_images(capture: Capture, cameras_world: dict[str, Camera], twin: Twin) -> list[PosedImages]:
    """Scan images that are not held out, evenly chosen."""
    withheld = set(held_out([path.name for path in capture.scan_images]))
    usable = [p for p in capture.scan_images if p.name in cameras_world and p.name not in withheld]
    chosen = np.unique(np.linspace(0, max(len(usable) - 1, 0), MAX_SCAN_IMAGES).astype(int))
    return [
        PosedImages(
            camera=cameras_world[usable[i].name],
            images_srgb=(read_image(usable[i]),),
            states=(twin.scan_state,),
        )
        for i in chosen[: len(usable)]
    ]


def select_training_frames(capture: Capture, frames: int) -> NDArray[np.int64]:
    """Which of the first fixed camera's frames the twin is fitted to; the others stay unseen."""
    count = max(int(DEMO_SHARE * min(len(capture.scan_images), MAX_SCAN_IMAGES)), MIN_DEMO_FRAMES)
    return np.unique(np.linspace(0, frames - 1, count).astype(np.int64))


def pose_demo_video(
    capture: Capture, camera_world: Camera, motion: MotionEstimate, twin: Twin, robot: RobotModel
) -> PosedImages:
    """The first fixed camera's video, as the scan would have exposed it, evenly chosen."""
    video = read_demo_videos(capture)[capture.cameras[0].name]
    chosen = select_training_frames(capture, len(video.times_s))
    times = video.times_s[chosen]
    joints, gripper = capture.joint_log.at(times + motion.clock_offset_s)
    states = tuple(
        TwinState(joints=q, gripper=float(g), theta=float(theta), T_world_object=twin.T_world_object)
        for q, g, theta in zip(joints, gripper, motion.theta_at(times), strict=True)
    )
    view = PosedImages(
        camera=camera_world, images_srgb=tuple(video.frames_srgb[i] for i in chosen), states=states
    )
    first = render_state(twin, robot, states[0], camera_world, features=(~twin.moves)[:, None] * 1.0)
    return match_exposure(view, np.asarray(first.rgb, np.float64), np.asarray(first.features)[..., 0] > 0.95)


def refine_appearance(
    twin: Twin, robot: RobotModel, views: Sequence[PosedImages], progress: Progress
) -> Twin:
    """The twin as all pictures show it.

    The robot's Gaussians are replaced by surfels of its model, the moving shadow is separated from the
    surface it falls on, then everything is fitted.

    Args:
        twin: The scan bound to its bodies.
        robot: Its robot.
        views: Of the scan, and last of a fixed camera.
        progress: Told how far it has come.
    """
    rng = np.random.default_rng(0)
    progress(0.1, "the robot's surface")
    with_surfels = replace_robot_gaussians(twin, robot, views, rng)
    progress(0.3, "the lamp that throws its shadow")
    lamp = _lamp(with_surfels, robot, views[-1])
    lit = with_surfels if lamp is None else remove_baked_shadow(with_surfels, robot, lamp)
    progress(0.4, "pictures in every configuration")
    return refine_twin(lit, robot, views, rng)


def _lamp(twin: Twin, robot: RobotModel, view: PosedImages) -> DirectionalLight | None:
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
    return find_directional_light(twin, robot, view, support.T_world_plane)
