"""Every Gaussian bound to the body that carries it, and everything fitted to scan and video. [paper 4.2.4]"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.appearance.drawer_interior import add_drawer_interior
from aomgen.appearance.refine import refine_twin
from aomgen.appearance.robot_surfels import replace_robot_gaussians
from aomgen.appearance.surfel_observations import match_exposure
from aomgen.conventions import MOVING, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.joint import Joint
from aomgen.core.light import DirectionalLight
from aomgen.core.parts import Parts, surface_points
from aomgen.core.progress import Progress
from aomgen.core.structure import held_out
from aomgen.errors import ReconstructionError
from aomgen.io.artifact import save_artifact
from aomgen.io.images import read_image
from aomgen.lighting.directional_light import find_directional_light
from aomgen.lighting.shadowed_twin import remove_baked_shadow, render_state
from aomgen.results import Results
from aomgen.robots.loading import save_robot
from aomgen.robots.robot import RobotConfiguration, RobotModel
from aomgen.twin.binding import bind, object_frame
from aomgen.twin.support import find_support
from aomgen.twin.twin import PosedImages, TwinModel, TwinState, pose_twin

# Largest number of scan images; more add little information and take as much time each.
MAX_SCAN_IMAGES = 80
# Number of video frames for each scan image; more frames from one camera reduce the quality of all other views.
DEMO_SHARE = 0.5
# Least number of frames, so that no part of the motion is skipped.
MIN_DEMO_FRAMES = 16


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Bind the scan to its bodies, fit the twin to all images, and write it with its robot."""
    scanned = bind_scan(results.scene, results.parts, results.motion.joint, results.configuration)
    video = pose_demo_video(results, scanned)
    bound = add_drawer_interior(scanned, results.robot, video)
    views = [*pose_scan_images(results, bound), video]
    twin = refine_appearance(bound, results.robot, views, progress)
    save_artifact(folder, "twin", twin)
    save_robot(folder, results.capture.robot)
    return {
        "gaussians": len(twin.gaussians),
        "moving": int(np.sum(twin.moves)),
        "tray": len(bound.gaussians) - len(scanned.gaussians),
    }


def bind_scan(scene: Gaussians, parts: Parts, joint: Joint, configuration: RobotConfiguration) -> TwinModel:
    """Bind the Gaussians of the scan, world frame, to the bodies that carry them, in the state of the scan."""
    static, moving = (surface_points(scene, parts.labels, label) for label in (STATIC, MOVING))
    state = TwinState(
        joints=configuration.joints,
        gripper=configuration.gripper,
        theta=0.0,
        T_world_object=object_frame(static, joint, moving),
    )
    return bind(scene, parts.labels, parts.robot_bodies, configuration.robot, joint, state)


def pose_scan_images(results: Results, twin: TwinModel) -> list[PosedImages]:
    """Scan images that are not held out, evenly chosen."""
    withheld = set(held_out(list(results.scan_images)))
    usable = [name for name in results.scan_images if name in results.scan_cameras and name not in withheld]
    chosen = np.unique(np.linspace(0, max(len(usable) - 1, 0), MAX_SCAN_IMAGES).astype(int))
    return [
        PosedImages(
            camera=results.scan_cameras[name],
            images_srgb=(read_image(results.scan_images[name]),),
            states=(twin.scan_state,),
        )
        for name in (usable[i] for i in chosen[: len(usable)])
    ]


def select_training_frames(images: int, frames: int) -> NDArray[np.int64]:
    """Select the indices of the first fixed camera's frames to which the twin is fitted, given the number of scan images."""
    count = max(int(DEMO_SHARE * min(images, MAX_SCAN_IMAGES)), MIN_DEMO_FRAMES)
    return np.unique(np.linspace(0, frames - 1, count).astype(np.int64))


def pose_demo_video(results: Results, twin: TwinModel) -> PosedImages:
    """Select evenly spaced frames of the first fixed camera's video, with their states and at the exposure of the scan."""
    video = results.videos[results.demo_camera]
    camera = results.fixed_camera.camera
    chosen = select_training_frames(len(results.scan_images), len(video.times_s))
    states = results.states_at(video.times_s[chosen], twin.T_world_object)
    images = tuple(video.frames_srgb[i] for i in chosen)
    view = PosedImages(camera=camera, images_srgb=images, states=states)
    still = (~twin.moves)[:, None] * 1.0
    first = render_state(twin, results.robot, states[0], camera, features=still)
    return match_exposure(view, np.asarray(first.rgb, np.float64), np.asarray(first.features)[..., 0] > 0.95)


def refine_appearance(
    twin: TwinModel, robot: RobotModel, views: Sequence[PosedImages], progress: Progress
) -> TwinModel:
    """Refine the twin so that its renderings match all images: those of the scan, and last those of a fixed camera.

    The robot's Gaussians are replaced by surfels of its model, and the moving shadow is separated from the surface below it.
    Then all Gaussians are fitted.
    """
    rng = np.random.default_rng(0)
    progress(0.1, "the robot's surface")
    with_surfels = replace_robot_gaussians(twin, robot, views, rng)
    progress(0.3, "direction of the light")
    directional = _find_cast_light(with_surfels, robot, views[-1])
    lit = with_surfels if directional is None else remove_baked_shadow(with_surfels, robot, directional)
    progress(0.4, "images in every configuration")
    return refine_twin(lit, robot, views, rng)


def _find_cast_light(twin: TwinModel, robot: RobotModel, view: PosedImages) -> DirectionalLight | None:
    """Estimate the directional light that casts shadows on the object's support; None without such a light or support."""
    world = pose_twin(twin, robot, twin.scan_state)
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    try:
        support = find_support(world.select(of_object), world.select(twin.of_scene), twin.T_world_object)
    except ReconstructionError:
        return None
    return find_directional_light(twin, robot, view, support.T_world_plane)
