"""Cameras of episodes: that of the demonstration, and one at a scan camera that shows the action from another side."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from aomgen.conventions import MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import angle_between, apply
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.replacement.correspondence import UP
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import TwinModel, TwinState, pose_twin

# Size of the images in which visibility is evaluated, [px].
LOOK_PX = (160, 120)
# A point is visible if the rendered surface is at most this much nearer than the point, [m].
CLEARANCE_M = 0.06
# Largest angle by which the second camera is turned towards the action, [rad], and smallest share of the key points that its
# image contains; the second pair applies if no camera satisfies the first.
DEMANDS = ((0.35, 0.9), (0.9, 0.6))
# Desired share of the second camera's image width that the action spans.
WANTED_SPAN = 0.6


def episode_cameras(results: Results) -> dict[str, Camera]:
    """Return the demonstration's camera and a new viewpoint, at the size of the episodes' images."""
    demo = results.demonstration
    first = results.fixed_camera.camera.resize(*results.project.image_size)
    frames = np.linspace(0, len(demo.times_s) - 1, 4).astype(int)
    held = apply(demo.Ts_world_ee[demo.contact_frames[0]], demo.grasp_ee)
    states = results.states_at(demo.times_s[frames], results.twin.T_world_object)
    key_points = [
        np.stack([demo.Ts_world_ee[t][:3, 3], apply(demo.joint.motion(demo.thetas[t]), held)]) for t in frames
    ]
    side = choose_viewpoint(results.scan_cameras, first, results.twin, results.robot, states, key_points)
    return {results.demo_camera: first, NEW_CAMERA: side}


def choose_viewpoint(
    scan_cameras: Mapping[str, Camera],
    first: Camera,
    twin: TwinModel,
    robot: RobotModel,
    states: Sequence[TwinState],
    key_points: Sequence[Array],
) -> Camera:
    """Find a camera that sees gripper and object from another side than the first one, whose optics it keeps.

    Args:
        scan_cameras: Registered scan cameras, world frame, by image name.
        states: A few states along the demonstration.
        key_points: Points (P, 3) that must be visible in each state, for example gripper and handle.

    Raises:
        ReconstructionError: There is no scan camera, or none sees the action.
    """
    if not scan_cameras:
        raise ReconstructionError("viewpoint", "no scan camera is registered", "scan the scene again")
    every = np.concatenate(list(key_points))
    scenes = [pose_twin(twin, robot, state) for state in states]
    of_object = np.isin(twin.labels, (STATIC, MOVING))
    framed = np.concatenate([every, *(_corners(scene.means[of_object]) for scene in scenes)])
    target = framed.mean(0)
    for max_turn, share in DEMANDS:
        best, best_score = None, -np.inf
        for name in sorted(scan_cameras):
            camera = first.move(look_at(scan_cameras[name].center, target))
            if not camera.T_world_cam[:3, 2] @ scan_cameras[name].T_world_cam[:3, 2] > np.cos(max_turn):
                continue
            score = _framing_score(camera, first, framed, share)
            # Seeing everything adds 1; only those are drawn that can still win.
            if score + 1.0 > best_score:
                score += _visible_share(camera.resize(*LOOK_PX), scenes, key_points)
                if score > best_score:
                    best, best_score = camera, score
        if best is not None:
            return best
    raise ReconstructionError(
        "viewpoint", "the action is not visible from any scan camera", "name a camera in the project file"
    )


def _corners(points: ArrayLike) -> Array:
    """Compute the corners (8, 3) of the box around points (N, 3), without the outermost 2 % at each end of each axis."""
    low, high = np.quantile(np.asarray(points, np.float64), (0.02, 0.98), axis=0)
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)


def _framing_score(camera: Camera, first: Camera, points: Array, share: float) -> float:
    """Score a camera by its angle to the first camera and by framing; -inf if it does not show the points."""
    small = camera.resize(*LOOK_PX)
    pixels, depths = small.project(points)
    size = np.array(LOOK_PX)
    inside = (depths > 0.3) & ((pixels > 0.06 * size) & (pixels < 0.94 * size)).all(1)
    if not inside.mean() >= share:
        return -np.inf
    span = float(np.ptp(pixels[:, 0])) / LOOK_PX[0]
    # The angle is measured in the top view.
    angle = angle_between(*((1 - UP) * (eye.center - points.mean(0)) for eye in (camera, first)))
    return float(min(angle / (np.pi / 2), 1.0) * 0.6 - abs(np.log(max(span, 0.01) / WANTED_SPAN)) * 0.4)


def _visible_share(camera: Camera, scenes: list[Gaussians], key_points: Sequence[Array]) -> float:
    """Compute the fraction of the key points that no surface hides."""
    shares = []
    for scene, points in zip(scenes, key_points, strict=True):
        pixels, depths = camera.project(points)
        u, v = np.clip(pixels, 0, np.array(LOOK_PX) - 1).astype(int).T
        nearest = render(scene, camera).depth[v, u]
        shares.append(((nearest <= 0) | (depths < nearest + CLEARANCE_M)).mean())
    return float(np.mean(shares))
