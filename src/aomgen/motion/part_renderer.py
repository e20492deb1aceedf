"""Renderer of the moving part, textured with its own pixels in the frames at rest, to compare with the video.

The scan provides the part's shape; its colors under the video's light and exposure are read from the video
before the motion. So neither the scan's exposure nor a constant error of the camera's pose counts as motion.
A rendered frame depends on at most five numbers (axis 2, origin 2, value 1), so its derivatives are
five more renderings: as cheap as one backward pass of the engine, and dense in pixels and unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aomgen.conventions import MOVING, ROBOT, luma_from_srgb
from aomgen.core.camera import Camera
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.joint import Joint
from aomgen.core.robust import compute_masked_median, regress, regress_robustly, weigh
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.io.images import resize
from aomgen.motion.inputs import MotionInput
from aomgen.motion.keyframes import widen
from aomgen.robots.silhouette import MasksAt
from aomgen.splatting.rasterizer import RigidParts, contribution_weights, render

FloatImage = NDArray[np.float32]

# Rim of the part that is excluded, pixels of the crop.
_RIM_PX = 2
# Rounds of back-projected residuals; each removes most of the remainder.
_PAINT_ROUNDS = 10
# A Gaussian whose weights sum to less than this share of a pixel is invisible.
_SEEN_WEIGHT = 0.02
# Number of frames at rest whose median is the texture: noise decreases to a third.
_REST_FRAMES = 9
# A gray level: smallest assumed standard deviation of a residual, 0..1.
_NOISE_FLOOR = 1 / 255
# A joint and a value of it.
JointState = tuple[Joint, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRendering:
    """The part as rendered at one joint value, images (H, W), 0..1.

    Blended luma, not divided by alpha; coverage by the part except where occluded; and coverage
    by its textured Gaussians.
    """

    luma: FloatImage
    alpha: FloatImage
    painted: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRenderer:
    """A crop of the video around the part's path, and the scene that can be rendered into it.

    Attributes:
        camera: Camera of the crop, world frame.
        frames: Frame indices that were read (N,).
        luma: Luma of the frames (N, H, W), 0..1.
        hidden: Masks of the robot with a margin (N, H, W).
        scene: Gaussians in the crop without the robot, degree 0.
        parts: 0 for static Gaussians, 1 for the moving part (G,).
        features: Luma, part and textured part (G, 3), zero for static Gaussians.
        focus: Mean of the part (3,), world frame, [m].
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
        """Render the part at a joint value."""
        Ts = np.stack([np.eye(4), joint.motion(theta)])
        images = _draw_features(self, self.features, RigidParts(indices=self.parts, Ts_world_part=Ts))
        luma, alpha, painted = np.moveaxis(images, -1, 0)
        return PartRendering(luma=luma, alpha=alpha, painted=painted)

    def at(self, frame: int) -> tuple[FloatImage, NDArray[np.bool_]]:
        """Return luma and hidden pixels (H, W) of a video frame that was read."""
        index = int(np.flatnonzero(self.frames == frame)[0])
        return self.luma[index], self.hidden[index]


def make_part_renderer(
    demo: MotionInput,
    masks_at: MasksAt,
    joint: Joint,
    moments: tuple[NDArray[np.intp], NDArray[np.intp], float],
    max_pixels: int,
) -> PartRenderer:
    """Crop the video to the part's path and texture the part.

    Args:
        demo, masks_at: Video, camera and scene; function that renders the robot's masks.
        joint: Approximate joint.
        moments: Frames at rest before the motion, frames of the motion, and the largest joint value.
        max_pixels: The crop is scaled to this many pixels at most.
    """
    resting, moving, largest = moments
    chosen = sample_resting(resting)
    frames = np.unique(np.concatenate([chosen, moving]))
    kept = demo.labels != ROBOT
    scene, moves = demo.scene.select(kept), demo.labels[kept] == MOVING
    solid = demo.points_moving
    places = [apply(joint.motion(theta), solid) for theta in np.linspace(0, largest, 8)]
    small, (rows, columns) = _choose_crop(demo.camera, places, max_pixels)
    camera = replace(
        small,
        cx=small.cx - columns.start,
        cy=small.cy - rows.start,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
    )
    images = [resize(demo.video.frames_srgb[k], small.width, small.height)[rows, columns] for k in frames]
    masks = masks_at(demo.video.times_s[frames], small.width, small.height)
    near = moves | _find_near(scene, camera)
    renderer = PartRenderer(
        camera=camera,
        frames=frames,
        luma=luma_from_srgb(np.stack(images)),
        hidden=widen(masks)[:, rows, columns],
        scene=scene.select(near).with_sh_degree(0),
        parts=moves[near].astype(np.int32),
        features=np.zeros((int(near.sum()), 3), np.float32),
        focus=solid.mean(0),
        reach_m=float(np.sqrt(((solid - solid.mean(0)) ** 2).sum(1).mean())),
    )
    return replace(renderer, features=_paint(renderer, np.isin(frames, chosen)))


def sample_resting(frames: NDArray[np.intp]) -> NDArray[np.intp]:
    """Sample a few of the frames (N,) at rest, evenly."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, _REST_FRAMES).round().astype(int))]


def _choose_crop(camera: Camera, places: list[Array], max_pixels: int) -> tuple[Camera, tuple[slice, slice]]:
    """Choose a camera resolution, and rows and columns around the part's points (N, 3) on its path."""
    bounds = np.array([np.percentile(camera.project(place)[0], [1, 99], axis=0) for place in places])
    low, high = bounds.min((0, 1)), bounds.max((0, 1))
    margin = 0.05 * (high - low) + 4
    size = np.array([camera.width, camera.height])
    low, high = np.clip(low - margin, 0, size - 8), np.clip(high + margin, 8, size)
    factor = min(1.0, float(np.sqrt(max_pixels / np.prod(high - low))))
    small = camera.resize(*np.round(size * factor).astype(int).tolist())
    first = np.floor(low * factor).astype(int)
    last = np.minimum(np.ceil(high * factor).astype(int), [small.width, small.height])
    return small, (slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0])))


def _find_near(scene: Gaussians, camera: Camera) -> NDArray[np.bool_]:
    """Find Gaussians (G,) in the image or near it."""
    pixels, depths = camera.project(scene.means)
    margin = 0.25 * max(camera.width, camera.height)
    size = np.array([camera.width, camera.height])
    return np.asarray((depths > 0) & ((pixels > -margin) & (pixels < size + margin)).all(1))


def _paint(renderer: PartRenderer, resting: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Fit each Gaussian's luma to the video at rest by back-projected residuals; returns features (G, 3)."""
    target, known = compute_masked_median(renderer.luma[resting], ~renderer.hidden[resting])
    weight = _gather(renderer, known)
    luma = luma_from_srgb(255 * np.clip(0.5 + SH_C0 * renderer.scene.sh[:, 0], 0, 1))
    seen = weight > _SEEN_WEIGHT
    for _ in range(_PAINT_ROUNDS):
        left = (target - _draw_features(renderer, luma[:, None])[..., 0]) * known
        luma = luma + np.where(seen, _gather(renderer, left) / np.maximum(weight, _SEEN_WEIGHT), 0)
    features = np.stack([luma, np.ones(len(luma)), seen], 1) * renderer.parts[:, None]
    return features.astype(np.float32)


def _gather(renderer: PartRenderer, image: NDArray) -> FloatImage:
    """Sum an image (H, W) over each Gaussian's pixels (G,), weighted by its share of them."""
    return contribution_weights(renderer.scene, renderer.camera, image[None].astype(np.float32))[:, 0]


def _draw_features(renderer: PartRenderer, features: NDArray, parts: RigidParts | None = None) -> FloatImage:
    drawn = render(renderer.scene, renderer.camera, features=features, parts=parts, threads=1)
    return np.asarray(drawn.features, np.float32)


def find_interior(view: PartRendering, hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find pixels (H, W) that are certainly inside the textured part and not hidden by the robot.

    The part's outline in the scan is the edge of a label, with an error of a
    pixel or two; its interior is exact.
    """
    sure = ndimage.binary_opening((view.alpha > 0.9) & (view.painted > 0.8 * view.alpha))
    return np.asarray(ndimage.binary_erosion(sure, iterations=_RIM_PX) & ~hidden, bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """Image detail that is compared: none finer than `blur_px`, no shading coarser than `wide_px`."""

    blur_px: float
    wide_px: float

    @property
    def noise_px(self) -> float:
        """Number of pixels that share their noise: a Gaussian blur's area, [px^2]."""
        return max(1.0, 4 * np.pi * self.blur_px**2)

    @property
    def shading_px(self) -> float:
        """Number of pixels that may share an error of the rendering, [px^2]."""
        return (2 * self.wide_px) ** 2


def linearize_frame(
    renderer: PartRenderer,
    frame: int,
    places: Sequence[JointState],
    steps: Array,
    band: Band,
    shift_sd_px: float,
) -> tuple[Array, Array, Array] | None:
    """Compute a frame's residuals (P,), derivatives (P, m) and weights (P,), 1 / variance, with light fitted.

    The result is None where the frame shows too little of the part.

    Args:
        renderer, frame: The video and the textured part.
        places: State to compare at, then those with one unknown each changed by its step.
        steps: The changes (m,).
        band: Detail that is compared.
        shift_sd_px: Standard deviation of smooth image displacements, which are no evidence.
    """
    picture, hidden = renderer.at(frame)
    first, *others = (renderer.draw(*place) for place in places)
    mask = find_interior(first, hidden)
    if mask.sum() < band.shading_px:
        return None
    changes = [
        (view.luma - first.luma - picture * (view.alpha - first.alpha)) / step
        for view, step in zip(others, steps, strict=True)
    ]
    slopes = np.gradient(first.luma)
    light = fit_gain(picture, first, mask, band, [*changes, *slopes])
    precisions = weigh(light.residuals, light.sd) / light.sd**2
    derivatives, slopes = np.split(light.others, [len(steps)], axis=1)
    shift_precision = np.linalg.eigvalsh(slopes.T * precisions @ slopes)[-1]
    weights = precisions / (band.noise_px + shift_sd_px**2 * shift_precision)
    return light.residuals, derivatives, weights


@dataclass(frozen=True, slots=True, kw_only=True)
class GainFit:
    """The detail (P,) of an image, and its residuals (P,) to a rendering at its best gain and offset, 0..1.

    `sd`: Robust standard deviation of the residuals. `others`: Other images' detail (P, M), gain
    and offset projected out.
    """

    detail: Array
    residuals: Array
    sd: float
    others: Array


def fit_gain(
    picture: FloatImage,
    view: PartRendering,
    mask: NDArray[np.bool_],
    band: Band,
    others: Sequence[NDArray[np.floating]] = (),
) -> GainFit:
    """Compare an image (H, W) with a rendering inside a mask, by a robust fit of gain and offset."""
    images = [picture * view.alpha - view.luma, view.luma, view.alpha, *others]
    bands = _extract_band(np.stack(images, -1).astype(np.float32), mask, band)
    light, targets = bands[:, 1:3], np.delete(bands, (1, 2), axis=1)
    _, weights, sd = regress_robustly(light, targets[:, 0], _NOISE_FLOOR)
    left = targets - light @ regress(light, targets, weights)
    return GainFit(detail=bands[:, 0] + bands[:, 1], residuals=left[:, 0], sd=sd, others=left[:, 1:])


def _extract_band(images: FloatImage, mask: NDArray[np.bool_], band: Band) -> Array:
    """Extract detail (P, C) of images (H, W, C) in the mask, without the finest scales and shading.

    The result is linear in the images, so that derivatives stay those of the residuals.
    """
    inside = mask[..., None].astype(np.float32)
    fine, coarse = (
        _blur(images * inside, sigma) / np.maximum(_blur(inside, sigma), 1e-3)
        for sigma in (band.blur_px, float(np.hypot(band.blur_px, band.wide_px)))
    )
    return np.asarray((fine - coarse)[mask], np.float64)


def _blur(images: FloatImage, sigma: float) -> FloatImage:
    return np.asarray(ndimage.gaussian_filter(images, (sigma, sigma, 0), mode="constant", truncate=3))
