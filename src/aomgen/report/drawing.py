"""Drawing on images: outlines, label colors, lines, sheets."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, binary_erosion

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera

# sRGB: blue, orange, pink.
LABEL_COLORS = {ROBOT: (64, 128, 255), STATIC: (255, 176, 32), MOVING: (230, 60, 120)}
Image8 = NDArray[np.uint8]


def overlay_outline(image: Image8, mask: NDArray[np.bool_], color: tuple[int, int, int]) -> Image8:
    """The mask's outline, two pixels wide, drawn over an image (H, W, 3)."""
    result = image.copy()
    result[np.asarray(binary_dilation(mask)) & ~np.asarray(binary_erosion(mask))] = color
    return result


def overlay_labels(image: Image8, labels: NDArray[np.uint8], strength: float = 0.5) -> Image8:
    """Part labels (H, W) as transparent colors over an image (H, W, 3)."""
    result = image.astype(np.float32)
    for label, color in LABEL_COLORS.items():
        mask = labels == label
        result[mask] = (1 - strength) * result[mask] + strength * np.array(color, np.float32)
    return result.astype(np.uint8)


def sheet(images: list[Image8], columns: int, *, gap: int = 4) -> Image8:
    """Images of one size side by side in rows."""
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    canvas = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        top, left = row * (height + gap), column * (width + gap)
        canvas[top : top + height, left : left + width] = image
    return canvas


def map_from_above(
    points_world: NDArray,
    colors_srgb: NDArray[np.uint8],
    cameras: list[Camera],
    *,
    width: int = 520,
) -> Image8:
    """Points (N, 3) in their colors (N, 3) as seen from above, the robot's base below, and where cameras stood.

    The robot's x axis points up in the image. Lower points are drawn first.
    """
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    ahead = np.array([camera.T_world_cam[:3, 2] for camera in cameras]).reshape(-1, 3)
    everything = np.concatenate([points_world, centers, np.zeros((1, 3))])[:, :2]
    low, high = everything.min(0) - 0.15, everything.max(0) + 0.15
    scale = width / (high[1] - low[1])

    def px(places: NDArray) -> list[tuple[float, float]]:
        return [((high[1] - y) * scale, (high[0] - x) * scale) for x, y in places[:, :2]]

    canvas = Image.new("RGB", (width, round((high[0] - low[0]) * scale)), (250, 251, 252))
    draw = ImageDraw.Draw(canvas)
    order = np.argsort(points_world[:, 2], kind="stable")
    for (x, y), color in zip(px(points_world[order]), colors_srgb[order], strict=True):
        draw.rectangle((x - 1, y - 1, x + 1, y + 1), fill=tuple(int(value) for value in color))
    for (x, y), end in zip(px(centers), px(centers + 0.12 * ahead), strict=True):
        draw.line(((x, y), end), fill=(90, 100, 115), width=1)
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=(40, 50, 65))
    ((x, y),) = px(np.zeros((1, 3)))
    draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=(40, 50, 65), width=2)
    return np.asarray(canvas)
