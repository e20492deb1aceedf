"""Prompts in undistorted images, and the number and viewing angles of the scan images that see them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import Prompt
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError

# The depth of a prompt is that of the sparse points inside it, or else of this number of nearest points.
NEAREST_POINTS = 5
# Least number of views that determine the depth of a surface.
MIN_VIEWS = 3
# Least angle between the outermost of these views, [deg]: an error of one pixel then causes an error of six pixels in depth
# (1 / sin(10 deg)).
MIN_ANGLE_DEG = 10.0
# Number of points along each side of a box that are undistorted: between them the curved outline deviates by less than a pixel.
EDGE_SAMPLES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptVisibility:
    """Visibility of one prompt.

    Attributes:
        part: robot, moving or static.
        registered: Whether that image is in the model.
        views: Number of registered images that contain the prompted location.
        angle_deg: Largest angle between their directions to it.
    """

    part: str
    image: str
    registered: bool
    views: int
    angle_deg: float


def undistort_prompts(prompts: tuple[Prompt, ...], lens: Lens) -> tuple[Prompt, ...]:
    """Transform prompts to the pixels of the undistorted images.

    A box becomes the box around its undistorted outline, cut at the image's border. Points outside the undistorted image are
    left out, and so are prompts without remaining points and box.
    """
    undistorted = (_undistort(prompt, lens) for prompt in prompts)
    return tuple(prompt for prompt in undistorted if len(prompt.points) or len(prompt.box))


def _undistort(prompt: Prompt, lens: Lens) -> Prompt:
    size = np.array([lens.width, lens.height], np.float64)
    points = prompt.points
    if len(points):
        pixels = lens.undistort(points[:, :2])
        kept = ((pixels >= 0) & (pixels <= size)).all(1)
        points = np.concatenate([pixels, points[:, 2:]], 1)[kept]
    box = prompt.box
    if len(box):
        x0, y0, x1, y1 = box
        share = np.linspace(0.0, 1.0, EDGE_SAMPLES)
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        edges = [(x, y0), (x, y1), (x0, y), (x1, y)]
        outline = np.concatenate([np.stack(np.broadcast_arrays(u, v), 1) for u, v in edges])
        pixels = np.clip(lens.undistort(outline), 0, size)
        low, high = pixels.min(0), pixels.max(0)
        box = np.concatenate([low, high]) if (high - low > 1).all() else np.zeros(0)
    return replace(prompt, points=points, box=box)


def measure_prompt_visibility(
    prompts: tuple[Prompt, ...],
    cameras_recon: dict[str, Camera],
    points_recon: Array,
    observations: NDArray[np.int32],
) -> list[PromptVisibility]:
    """Count the views of each prompted location and measure the angle between them.

    Args:
        prompts: Prompts in pixels of the undistorted images of `cameras_recon`.
        cameras_recon: Registered images, in name order.
        observations: (M, 2), rows of (point, index of image).

    Not checked: occlusion.
    """
    names, cameras = list(cameras_recon), list(cameras_recon.values())
    found = []
    for prompt in prompts:
        registered, views, angle_deg = prompt.image in cameras_recon, 0, 0.0
        if registered:
            seen = observations[observations[:, 1] == names.index(prompt.image), 0]
            place = _place(prompt, cameras_recon[prompt.image], points_recon[seen])
            views, angle_deg = (0, 0.0) if place is None else _views(place, cameras)
        found.append(
            PromptVisibility(
                part=prompt.part,
                image=prompt.image,
                registered=registered,
                views=views,
                angle_deg=angle_deg,
            )
        )
    return found


def require_coverage(found: list[PromptVisibility]) -> None:
    """Refuse a scan that does not cover a prompted part.

    Raises:
        ReconstructionError: The model contains none of the images with prompts for a part, or too few views show the part, or
            from too few sides.
    """
    for part in sorted({item.part for item in found}):
        own = [item for item in found if item.part == part]
        names = ", ".join(item.image for item in own)
        if not any(item.registered for item in own):
            raise ReconstructionError(
                "scan",
                f"the images prompted for the {part} part ({names}) could not be registered",
                "prompt it on another image",
            )
        best = max(own, key=lambda item: (min(item.views, MIN_VIEWS), item.angle_deg))
        if not (best.views >= MIN_VIEWS and best.angle_deg >= MIN_ANGLE_DEG):
            raise ReconstructionError(
                "scan",
                f"the {part} part prompted on {best.image} is visible in {best.views} images over "
                f"{best.angle_deg:.0f} deg, at least {MIN_VIEWS} over {MIN_ANGLE_DEG:.0f} deg are needed",
                "record it from more sides",
            )


def _place(prompt: Prompt, camera: Camera, points_recon: Array) -> Array | None:
    """Compute the position (3,) of a prompt: on the ray through its center, at the depth of the points there."""
    pixel = _middle(prompt)
    if not len(points_recon):
        return None
    pixels, depths = camera.project(points_recon)
    distances = np.linalg.norm(pixels - pixel, axis=1)
    inside = np.argsort(distances)[:NEAREST_POINTS]
    if len(prompt.box):
        x0, y0, x1, y1 = prompt.box
        within = ((pixels >= [x0, y0]) & (pixels <= [x1, y1])).all(1)
        if within.sum() >= NEAREST_POINTS:
            inside = np.flatnonzero(within)
    ray_cam = np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0])
    depth = float(np.median(depths[inside]))
    return camera.T_world_cam[:3, :3] @ (depth * ray_cam) + camera.center


def _middle(prompt: Prompt) -> Array:
    on_part = prompt.points[prompt.points[:, 2] > 0.5] if len(prompt.points) else prompt.points
    if len(on_part):
        return on_part[:, :2].mean(0)
    if len(prompt.box):
        return prompt.box.reshape(2, 2).mean(0)
    return prompt.points[:, :2].mean(0)


def _views(place: Array, cameras: list[Camera]) -> tuple[int, float]:
    directions = []
    for camera in cameras:
        pixel, depth = camera.project(place[None])
        inside = (pixel[0] >= 0).all() and (pixel[0] <= [camera.width, camera.height]).all()
        if depth[0] > 0 and inside:
            away = camera.center - place
            directions.append(away / np.linalg.norm(away))
    if len(directions) < 2:
        return len(directions), 0.0
    cosines = np.array(directions) @ np.array(directions).T
    return len(directions), float(np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))
