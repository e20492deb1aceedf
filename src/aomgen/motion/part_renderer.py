"""The video around the moving part, and the part painted with what the video shows of it at rest.

The scan knows the part's shape; its colors under the video's light, exposure and white balance are
read from the video itself, before the motion. What is compared later is the same surface in the same
video, so that neither the scan's exposure nor a constant error of the camera's pose counts as motion.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.joint import Joint
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.motion.filters import dilate
from aomgen.motion.inputs import MotionInput
from aomgen.robots.robot_masks import MasksAt
from aomgen.splatting.rasterizer import RigidParts, contribution_weights, render

FloatImage = NDArray[np.float32]

# Rec. 601 luma.
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
# Rounds of back-projected residuals; each takes most of what is left.
_PAINT_ROUNDS = 10
# A Gaussian whose weights sum to less than this share of a pixel is not seen.
_SEEN_WEIGHT = 0.02
# Frames at rest whose median is the picture that is painted: noise falls to a third.
_REST_FRAMES = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRendering:
    """The part as drawn at one joint value.

    Attributes:
        luma: Blended luma (H, W), not divided by alpha, 0..1.
        alpha: Coverage by the part (H, W), 0..1, what stands before it left out.
        painted: Coverage by those of its Gaussians that the video shows at rest (H, W), 0..1.
    """

    luma: FloatImage
    alpha: FloatImage
    painted: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRenderer:
    """A crop of the video around the part's way, and the scene that can be drawn into it.

    Attributes:
        camera: Of the crop, world frame.
        frames: Frame indices that were read (N,).
        luma: Their luma (N, H, W), 0..1.
        hidden: Robot with a margin (N, H, W).
        scene: Gaussians in the crop without the robot, degree 0.
        parts: 0 what stands, 1 the moving part (G,).
        features: Luma, part and painted part (G, 3), zero for what stands.
        focus: Middle of the part (3,), world frame, [m].
        reach_m: RMS distance of the part's Gaussians from it, [m].
    """

    camera: Camera
    frames: NDArray[np.intp]
    luma: FloatImage
    hidden: NDArray[np.bool_]
    scene: Gaussians
    parts: NDArray[np.int32]
    features: NDArray[np.float32]
    focus: Array
    reach_m: float

    def draw(self, joint: Joint, theta: float) -> PartRendering:
        """The part at a joint value, without gradients."""
        Ts = np.stack([np.eye(4), joint.motion(theta)])
        parts = RigidParts(indices=self.parts, Ts_world_part=Ts)
        drawn = render(self.scene, self.camera, features=self.features, parts=parts, threads=1).features
        images = np.moveaxis(np.zeros((1, 1, 3), np.float32) if drawn is None else drawn, -1, 0)
        return PartRendering(luma=images[0], alpha=images[1], painted=images[2])

    def at(self, frame: int) -> tuple[FloatImage, NDArray[np.bool_]]:
        """Luma and hidden pixels (H, W) of a video frame that was read."""
        index = int(np.flatnonzero(self.frames == frame)[0])
        return self.luma[index], self.hidden[index]


def make_part_renderer(
    demo: MotionInput,
    masks_at: MasksAt,
    joint: Joint,
    moments: tuple[NDArray[np.intp], NDArray[np.intp], float],
    *,
    max_pixels: int,
    dilate_px: int,
) -> PartRenderer:
    """Cut the video to the part's way and paint the part.

    Args:
        demo: Video, camera and scene.
        masks_at: Draws the robot.
        joint: Where the part goes, roughly.
        moments: Frames at rest before the motion, frames of the motion, and the largest joint value.
        max_pixels: The crop is scaled to this many pixels at most.
        dilate_px: Margin around the robot, in pixels of the crop.
    """
    resting, moving, largest = moments
    chosen = resting[np.unique(np.linspace(0, len(resting) - 1, _REST_FRAMES).round().astype(int))]
    frames = np.unique(np.concatenate([chosen, moving]))
    kept = demo.labels != ROBOT
    scene, moves = demo.scene.select(kept), demo.labels[kept] == MOVING
    solid = demo.points_moving
    places = [apply(joint.motion(theta), solid) for theta in np.linspace(0, largest, 8)]
    small, (rows, columns) = _crop(demo.camera, places, max_pixels)
    camera = replace(
        small,
        cx=small.cx - columns.start,
        cy=small.cy - rows.start,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
    )
    images = [resize(demo.video.frames_srgb[k], small.width, small.height)[rows, columns] for k in frames]
    masks = masks_at(demo.video.times_s[frames], small.width, small.height)
    hidden = np.stack([dilate(mask, dilate_px)[rows, columns] for mask in masks])
    luma = np.asarray(np.stack(images).astype(np.float32) @ _LUMA / 255, np.float32)
    near = moves | _in_view(scene, camera)
    renderer = PartRenderer(
        camera=camera,
        frames=frames,
        luma=luma,
        hidden=hidden,
        scene=scene.select(near).with_sh_degree(0),
        parts=moves[near].astype(np.int32),
        features=np.zeros((int(near.sum()), 3), np.float32),
        focus=solid.mean(0),
        reach_m=float(np.sqrt(((solid - solid.mean(0)) ** 2).sum(1).mean())),
    )
    return replace(renderer, features=_painted(renderer, np.isin(frames, chosen)))


def _crop(camera: Camera, places: list[Array], max_pixels: int) -> tuple[Camera, tuple[slice, slice]]:
    """The camera at a fitting resolution, and rows and columns around the places of the part."""
    pixels = np.concatenate([np.percentile(camera.project(place)[0], [1, 99], axis=0) for place in places])
    margin = 0.05 * np.ptp(pixels, axis=0) + 4
    low, high = pixels.min(0) - margin, pixels.max(0) + margin
    low, high = (
        np.clip(low, 0, [camera.width - 8, camera.height - 8]),
        np.clip(high, 8, [camera.width, camera.height]),
    )
    factor = min(1.0, float(np.sqrt(max_pixels / np.prod(high - low))))
    small = camera.resized(round(camera.width * factor), round(camera.height * factor))
    first, last = np.floor(low * factor).astype(int), np.ceil(high * factor).astype(int)
    last = np.minimum(last, [small.width, small.height])
    return small, (slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0])))


def _in_view(scene: Gaussians, camera: Camera) -> NDArray[np.bool_]:
    pixels, depths = camera.project(scene.means)
    margin = 0.25 * max(camera.width, camera.height)
    size = np.array([camera.width, camera.height])
    return np.asarray((depths > 0) & ((pixels > -margin) & (pixels < size + margin)).all(1))


def _painted(renderer: PartRenderer, resting: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Features (G, 3) with each Gaussian's luma fitted to the video at rest, by back-projected residuals."""
    shown = ~renderer.hidden[resting]
    counted = shown.sum(0)
    bare = np.where(shown, renderer.luma[resting], np.nan)
    bare[:, counted == 0] = 0
    target, open_ = np.nanmedian(bare, axis=0).astype(np.float32), (counted > 0).astype(np.float32)
    weight = contribution_weights(renderer.scene, renderer.camera, open_[None])[:, 0]
    luma = (np.clip(0.5 + SH_C0 * renderer.scene.sh[:, 0], 0, 1) @ _LUMA).astype(np.float32)
    ones = np.ones(len(luma), np.float32)
    seen = weight > _SEEN_WEIGHT
    for _ in range(_PAINT_ROUNDS):
        drawn = render(renderer.scene, renderer.camera, features=luma[:, None], threads=1).features
        left = (target - (0 if drawn is None else drawn[..., 0])) * open_
        share = contribution_weights(renderer.scene, renderer.camera, left[None].astype(np.float32))[:, 0]
        luma = luma + np.where(seen, share / np.maximum(weight, _SEEN_WEIGHT), 0).astype(np.float32)
    moving = renderer.parts.astype(np.float32)
    return np.stack([luma, ones, seen.astype(np.float32)], 1) * moving[:, None]


def find_interior(view: PartRendering, hidden: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """Pixels (H, W) surely inside the painted part and not hidden by the robot.

    The part's outline in the scan is a label's edge, a pixel or two off; what lies inside is not.
    """
    sure = ndimage.binary_opening((view.alpha > 0.9) & (view.painted > 0.8 * view.alpha))
    return np.asarray(ndimage.binary_erosion(sure, iterations=margin_px) & ~hidden, bool)
