"""Observed colors of the robot's surface: one for every surfel in every image that sees it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from aomgen.core.exposure import change_exposure, fit_gains
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import RigidParts
from aomgen.twin.twin import PosedImages, TwinModel, body_poses, moving_layer, static_layer


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfelObservations:
    """Colors of surfels (discs): N observations in V images.

    Attributes:
        disc: Index into the relit Gaussians of the twin.
        image_index: Index of the image.
        color_srgb: Mean color, 0..1.
        pixels: Number of pixels that show the disc.
        directions_body: Unit direction from the camera to the disc, in its body's frame.
        Ts_world_body: Body poses in every image (V, B, 4, 4).
    """

    disc: Annotated[NDArray[np.int64], "N"]
    image_index: Annotated[NDArray[np.int64], "N"]
    color_srgb: Annotated[Array, "N 3"]
    pixels: Annotated[Array, "N"]
    directions_body: Annotated[Array, "N 3"]
    Ts_world_body: Annotated[Array, "_ _ 4 4"]

    __post_init__ = freeze_arrays


def observe_surfels(twin: TwinModel, robot: RobotModel, views: Sequence[PosedImages]) -> SurfelObservations:
    """Measure the color of every surfel in every image where it is visible.

    The surfels (M) are the relit Gaussians of the twin, all of which move; its other Gaussians may hide them.
    """
    moving = moving_layer(twin.select(twin.moves))
    first_disc = len(twin.gaussians) - len(twin.relit_bodies)
    pieces, poses = [], []
    for view in views:
        layer = static_layer(twin, view.camera)
        for image, state in zip(view.images_srgb, view.states, strict=True):
            Ts = body_poses(twin, robot, state)
            eyes_body = apply(invert(Ts), view.camera.center)
            parts = RigidParts(indices=moving.bodies, Ts_world_part=Ts)
            drawn = layer.session.draw(moving.gaussians, parts, with_ids=True)
            discs = np.asarray(drawn.max_id).astype(np.int64) - first_disc
            # Outlines are left out, because pixels there also show the background, and the cameras have errors of about one pixel.
            seen = binary_erosion(discs >= 0)
            which, inverse, pixels = np.unique(discs[seen], return_inverse=True, return_counts=True)
            colors = image[seen] / 255.0
            sums = np.stack([np.bincount(inverse, colors[:, c], len(which)) for c in range(3)], 1)
            towards = twin.gaussians.means[first_disc + which] - eyes_body[twin.bodies[first_disc + which]]
            directions = towards / np.linalg.norm(towards, axis=1, keepdims=True)
            pieces.append(
                (which, np.full(len(which), len(poses)), sums / pixels[:, None], pixels, directions)
            )
            poses.append(Ts)
    disc, image_index, color, pixels, directions = (
        np.concatenate(items) for items in zip(*pieces, strict=True)
    )
    return SurfelObservations(
        disc=disc,
        image_index=image_index,
        color_srgb=color,
        pixels=pixels,
        directions_body=directions,
        Ts_world_body=np.stack(poses),
    )


def match_exposure(view: PosedImages, drawn_srgb: Array, compared: NDArray[np.bool_]) -> PosedImages:
    """Match exposure and white balance to those of the scan.

    The first image of the view is compared with `drawn_srgb` (H, W, 3), 0..1, at the given pixels (H, W).
    """
    gains = fit_gains(view.images_srgb[0][compared] / 255, drawn_srgb[compared])
    return replace(view, images_srgb=tuple(change_exposure(image, gains) for image in view.images_srgb))


def pixel_size(robot: RobotModel, twin: TwinModel, views: Sequence[PosedImages]) -> float:
    """Compute the size of a pixel at the robot, [m], as the median over the images."""
    places = body_poses(twin, robot, twin.scan_state)[1 : 1 + len(robot.body_names), :3, 3]
    sizes = [
        np.median(np.linalg.norm(places - view.camera.center, axis=1)) / max(view.camera.fx, view.camera.fy)
        for view in views
    ]
    return float(np.median(sizes))
