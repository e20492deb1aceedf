"""Render a good and some bad walks around the scene of a run, for the capture sheet of the documentation."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.core.walk import find_target
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import STAGES, find_project
from aomgen.splatting.rasterizer import render

Image8 = NDArray[np.uint8]
# Size of one image, [px]; five of them and a plan are a strip.
SIZE: Final = (256, 192)
SHOWN: Final = 5
# The plan is seen from this many times the distance of the cameras, so that all of them are in it.
PLAN_HEIGHT: Final = 3.4
# Surfaces above the cameras hide the scene from the plan: share of the cameras' height that is shown.
PLAN_CUT: Final = 1.1
# Frames of a blurred image, and rotation of the camera while it is exposed, [rad].
BLUR_FRAMES, BLUR_RAD = 9, 0.05
# Factors on the light of images whose exposure is not locked.
EXPOSURES: Final = (0.45, 1.9)
GOOD, BAD = (44, 122, 75), (179, 38, 30)


def draw_walks(run: Path, folder: Path) -> list[Path]:
    """Write one JPEG for each walk: a plan of its cameras, and images of five of them.

    Args:
        run: Run that is finished up to its alignment.
        folder: Receives `walk_good.jpg`, `walk_one_side.jpg`, `walk_turning.jpg` and `walk_blurred.jpg`.
    """
    results = results_of(find_project(run), STAGES)
    scene, cameras = results.gaussians, list(results.scan_cameras.values())
    cameras = [camera.resize(*SIZE) for camera in cameras]
    target = find_target([camera.T_world_cam for camera in cameras])
    walks = {
        "walk_good.jpg": (cameras, [_draw(scene, camera) for camera in spread(cameras)], GOOD),
        "walk_one_side.jpg": _walk(scene, stay_on_one_side(cameras, target)),
        "walk_turning.jpg": _walk(scene, turn_on_the_spot(cameras, target)),
        "walk_blurred.jpg": (cameras, _spoil(scene, spread(cameras)), BAD),
    }
    paths = []
    for name, (path, images, color) in walks.items():
        strip = np.concatenate([_draw_plan(scene, cameras, path, target, color), *images], axis=1)
        paths.append(folder / name)
        Image.fromarray(strip).save(paths[-1], quality=80, optimize=True)
    return paths


def _walk(scene: Gaussians, cameras: list[Camera]) -> tuple[list[Camera], list[Image8], tuple[int, int, int]]:
    return cameras, [_draw(scene, camera) for camera in spread(cameras)], BAD


def spread(cameras: Sequence[Camera]) -> list[Camera]:
    """Five cameras from the whole walk."""
    picked = np.linspace(0, len(cameras) - 1, SHOWN + 1).round().astype(int)[:-1]
    return [cameras[index] for index in picked]


def stay_on_one_side(cameras: list[Camera], target: NDArray[np.float64]) -> list[Camera]:
    """The cameras within 30 degrees of the first one, seen from the target."""
    directions = np.array([(camera.center - target)[:2] for camera in cameras])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near = directions @ directions[0] > np.cos(np.radians(30))
    return [camera for camera, chosen in zip(cameras, near, strict=True) if chosen]


def turn_on_the_spot(cameras: list[Camera], target: NDArray[np.float64]) -> list[Camera]:
    """One position from which the camera turns to either side."""
    center = cameras[0].center
    walk = []
    for angle in np.linspace(-0.5, 0.5, 12):
        R = matrix_from_rotvec(np.array([0.0, 0.0, angle]))
        walk.append(cameras[0].move(look_at(center, center + R @ (target - center), (0.0, 0.0, 1.0))))
    return walk


def _spoil(scene: Gaussians, cameras: list[Camera]) -> list[Image8]:
    """Images with motion blur, of another exposure, and too near."""
    first, second, third, fourth, fifth = cameras
    near = replace(third, fx=3 * third.fx, fy=3 * third.fy)
    return [
        _blur(scene, first),
        _draw(scene, second, EXPOSURES[0]),
        _draw(scene, near),
        _draw(scene, fourth, EXPOSURES[1]),
        _blur(scene, fifth),
    ]


def _blur(scene: Gaussians, camera: Camera) -> Image8:
    """The mean over an exposure in which the camera turns."""
    frames = []
    for angle in np.linspace(0, BLUR_RAD, BLUR_FRAMES):
        turn = transform(matrix_from_rotvec(np.array([0.4 * angle, angle, 0.0])), np.zeros(3))
        frames.append(_draw(scene, camera.move(camera.T_world_cam @ turn)).astype(np.float32))
    return np.mean(frames, axis=0).astype(np.uint8)


def _draw(scene: Gaussians, camera: Camera, gain: float = 1.0) -> Image8:
    rgb = np.clip(render(scene, camera).rgb, 0.0, 1.0)
    return np.asarray(np.rint(255 * np.clip(rgb**2.2 * gain, 0, 1) ** (1 / 2.2)), np.uint8)


def _draw_plan(
    scene: Gaussians,
    cameras: list[Camera],
    walk: list[Camera],
    target: NDArray[np.float64],
    color: tuple[int, int, int],
) -> Image8:
    """The scene from above, with the positions and directions of a walk's cameras."""
    centers = np.array([camera.center for camera in cameras])
    top = target[2] + PLAN_CUT * (centers[:, 2].max() - target[2])
    reach = float(np.linalg.norm((centers - target)[:, :2], axis=1).max())
    eye = np.append(target[:2], target[2] + PLAN_HEIGHT * reach)
    plan = cameras[0].move(look_at(eye, target, (0.0, 1.0, 0.0)))
    image = Image.fromarray(_draw(scene.select(scene.means[:, 2] < top), plan))
    pen = ImageDraw.Draw(image)
    for camera in walk:
        ends = np.stack([camera.center, camera.center + 0.15 * reach * camera.T_world_cam[:3, 2]])
        (start, end), _ = plan.project(ends)
        pen.line([*start, *end], fill=color, width=1)
        pen.ellipse([start[0] - 3, start[1] - 3, start[0] + 3, start[1] + 3], fill=color, outline="white")
    pen.text(
        (6, 4),
        f"{len(walk)} images",
        fill=color,
        font=ImageFont.load_default(size=14),
        stroke_width=2,
        stroke_fill="white",
    )
    return np.asarray(image)
