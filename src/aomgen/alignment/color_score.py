"""Color score of many poses of the robot: difference in color between its silhouette and a band around it.

The robot has the same colors in all images, and others than its surroundings. Colors inside and just outside
the silhouette, pooled over a few small images, differ most at the true pose. Silhouettes are
drawn as points on the surface, thousands in a second; good poses are verified by contours later.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans, vq

from aomgen.alignment.contours import AlignmentImage
from aomgen.core.values import Array
from aomgen.robots.robot import RobotConfiguration

# Colors in the palette of the images; k-means merges similar ones, so more change little.
COLORS = 40
# Width of the band, as a share of the image's width: less than an arm's link is thick.
RIM = 0.06
# A silhouette of which less than this is in the images says less.
SEEN = 0.5
# Poses scored at once: bounds the memory, no effect on the result.
BATCH = 128


@dataclass(frozen=True, slots=True, kw_only=True)
class ColorScore:
    """Small images in few colors, and points on the posed robot.

    Attributes:
        views: The small images.
        labels: Of each view, (H * W, COLORS) float32, one-hot.
        points_world: Points spread over the robot's surface (P, 3), [m].
    """

    views: list[AlignmentImage]
    labels: list[NDArray[np.float32]]
    points_world: Array

    def __call__(self, Ss_world_recon: Array) -> Array:
        """Scores (H,) of similarities (H, 4, 4): 0 = colors do not differ; more for larger outlines."""
        batches = range(0, len(Ss_world_recon), BATCH)
        return np.concatenate([self._batch(Ss_world_recon[first : first + BATCH]) for first in batches])

    def _batch(self, Ss_world_recon: Array) -> Array:
        Ss_recon_world = np.asarray(np.linalg.inv(Ss_world_recon), np.float64)
        count = len(Ss_world_recon)
        inside, outside = np.zeros((count, COLORS)), np.zeros((count, COLORS))
        seen = np.zeros(count)
        for view, labels in zip(self.views, self.labels, strict=True):
            masks, share = self._silhouettes(view, Ss_recon_world)
            rims = _dilate(masks, max(2, round(RIM * view.camera_recon.width))) & ~masks
            inside += masks.reshape(count, -1).astype(np.float32) @ labels
            outside += rims.reshape(count, -1).astype(np.float32) @ labels
            seen += share / len(self.views)
        # Pixels of one link are alike: evidence grows with the length of the outline, not with area.
        length = np.sqrt(inside.sum(1) / sum(len(labels) for labels in self.labels))
        return divergence(inside, outside) * length * np.minimum(seen / SEEN, 1.0)

    def _silhouettes(self, view: AlignmentImage, Ss_recon_world: Array) -> tuple[NDArray[np.bool_], Array]:
        """Masks (H, h, w), and which share of the robot is in the image (H,)."""
        camera = view.camera_recon
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        Ms = K @ (camera.T_cam_world @ Ss_recon_world)[:, :3]
        # Pixels are whole numbers here: single precision is more than enough.
        u, v, z = np.einsum("hij,pj->ihp", Ms.astype(np.float32), self._homogeneous(), optimize=True)
        depth = np.maximum(z, np.float32(1e-6))
        u, v = np.floor(u / depth), np.floor(v / depth)
        width, height = camera.width, camera.height
        inside = (z > 1e-6) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        first = np.arange(len(Ms), dtype=np.int64)[:, None] * (width * height)
        masks = np.zeros(len(Ms) * width * height, bool)
        masks[(first + np.where(inside, v * width + u, 0).astype(np.int64))[inside]] = True
        masks = masks.reshape(len(Ms), height, width)
        return ~_dilate(~_dilate(masks, 1), 1), inside.mean(1)

    def _homogeneous(self) -> NDArray[np.float32]:
        ones = np.ones((len(self.points_world), 1))
        return np.concatenate([self.points_world, ones], 1).astype(np.float32)


def color_score(
    views: list[AlignmentImage],
    configuration: RobotConfiguration,
    rng: np.random.Generator,
    points: int = 1200,
) -> ColorScore:
    """Prepare small images for quick looks.

    Args:
        views: Images, some 80 px wide: an arm's link is then a few pixels thick.
        configuration: The robot during the scan.
        rng: Chooses points and colors.
        points: On the robot's surface; enough that neighbours are a pixel apart.
    """
    pixels = [view.image_srgb.reshape(-1, 3).astype(np.float32) for view in views]
    palette = _palette(np.concatenate(pixels), rng)
    one_hot = np.eye(COLORS, dtype=np.float32)
    return ColorScore(
        views=views,
        labels=[one_hot[vq(part, palette)[0]] for part in pixels],
        points_world=configuration.surface_world(points, rng),
    )


def divergence(inside: Array, outside: Array) -> Array:
    """Jensen-Shannon divergence (H,) between two rows of counts (H, K), 0..1, less its bias.

    Few counts differ by chance; to first order by (K - 1) / (4 ln 2) * (1/n + 1/m) bits over 2.
    """
    n, m = inside.sum(1, keepdims=True), outside.sum(1, keepdims=True)
    p, q = inside / np.maximum(n, 1), outside / np.maximum(m, 1)
    mean = (p + q) / 2
    bits = _relative_bits(p, mean) / 2 + _relative_bits(q, mean) / 2
    used = np.sum(mean > 0, axis=1)
    bias = (used - 1) / (8 * np.log(2)) * (1 / np.maximum(n, 1) + 1 / np.maximum(m, 1))[:, 0]
    return np.asarray(np.clip(bits - bias, 0, 1), np.float64)


def _relative_bits(p: Array, mean: Array) -> Array:
    positive = p > 0
    ratio = np.where(positive, p, 1) / np.where(positive, mean, 1)
    return np.sum(p * np.log2(ratio), axis=1)


def _palette(pixels: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """The images' most typical colors (COLORS or fewer, 3), from some of the pixels."""
    sample = pixels[rng.permutation(len(pixels))[:6000]]
    return kmeans(sample, sample[:COLORS])[0]


def _dilate(masks: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Masks (H, h, w) dilated by a square of side 2 * by + 1."""
    for axis in (1, 2):
        reach = 0
        while reach < by:
            # Doubling: a mask grown by r, moved by up to r + 1 both ways, is grown by 2 r + 1.
            step = min(reach + 1, by - reach)
            grown = masks.copy()
            low, high = [slice(None)] * 3, [slice(None)] * 3
            low[axis], high[axis] = slice(None, -step), slice(step, None)
            grown[tuple(low)] |= masks[tuple(high)]
            grown[tuple(high)] |= masks[tuple(low)]
            masks, reach = grown, reach + step
    return masks
