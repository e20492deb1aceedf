"""The recovered joint drawn into a frame: its axis with what is not known about it, path, part and contact."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull, QhullError

from aomgen.core.camera import Camera
from aomgen.core.motion import MotionEstimate
from aomgen.core.transforms import apply
from aomgen.core.values import Array

Image8 = NDArray[np.uint8]
AXIS, PATH, TOUCH = (40, 220, 255), (255, 80, 60), (255, 230, 60)
# How strongly the space in which the axis lies covers the image.
VEIL = 110
STATIONS, SIDES = 9, 24
# What is nearer to the camera is not drawn, [m].
NEAR_M = 0.05
# A contact is drawn no smaller than a finger's pad, and its normal as long as a finger, [m].
PATCH_M, NORMAL_M = 0.008, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisSpace:
    """Where the axis lies with 95 %: circles along it.

    Attributes:
        centers: Middles (K, 3), along the estimated axis, world frame, [m].
        radii: (K,), [m].
        axis: Unit direction (3,).
    """

    centers: Array
    radii: Array
    axis: Array

    def circles(self) -> Array:
        """Points (K, SIDES, 3) on the circles."""
        first = np.cross(self.axis, np.eye(3)[int(np.argmin(np.abs(self.axis)))])
        first /= np.linalg.norm(first)
        turns = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
        ring = np.outer(np.cos(turns), first) + np.outer(np.sin(turns), np.cross(self.axis, first))
        return self.centers[:, None] + self.radii[:, None, None] * ring


def axis_space(motion: MotionEstimate, held_world: Array) -> AxisSpace:
    """The 95 % space of an axis, as long as the part reaches from it.

    Revolute: a waist at the foot of the held point, as wide as the line's place is unknown, which
    opens to both sides with the unknown of its direction. Prismatic: a cone from the held point to
    where the part ends.

    Args:
        motion: The estimate.
        held_world: The held point when the motion begins (3,), [m].
    """
    joint = motion.joint
    if joint.type == "prismatic":
        along, start, waist = np.linspace(0, joint.upper, STATIONS), held_world, 0.0
    else:
        start = joint.origin + ((held_world - joint.origin) @ joint.axis) * joint.axis
        reach = 0.7 * float(np.linalg.norm(held_world - start))
        along, waist = np.linspace(-reach, reach, STATIONS), motion.origin_ci95_m
    radii = waist + np.abs(along) * np.tan(min(motion.axis_ci95_rad, 1.2))
    return AxisSpace(centers=start + along[:, None] * joint.axis, radii=radii, axis=joint.axis)


def overlay_motion(
    image_srgb: Image8, camera: Camera, motion: MotionEstimate, held_world: Array, theta: float
) -> Image8:
    """Axis, its 95 % space, the held point's path and the contact patches over one frame.

    Args:
        image_srgb: Frame (H, W, 3).
        camera: Its camera, world frame.
        motion: The estimate.
        held_world: The held point when the motion begins (3,), [m].
        theta: Joint value at the frame; the patches are drawn where the part carried them.
    """
    canvas = Image.fromarray(image_srgb).convert("RGBA")
    space = axis_space(motion, held_world)
    _veil(canvas, camera, space)
    draw = ImageDraw.Draw(canvas)
    joint = motion.joint
    values = np.linspace(joint.lower, joint.upper, 40)
    _polyline(draw, camera, apply(joint.motion(values), held_world), PATH, 2)
    _polyline(draw, camera, space.centers, AXIS, 2)
    _arrow_head(draw, camera, space.centers)
    carried = joint.motion(theta)
    for patch in motion.contacts:
        middle, normal = apply(carried, patch.point), carried[:3, :3] @ patch.normal
        ring = AxisSpace(
            centers=middle[None], radii=np.array([max(patch.spread_m, PATCH_M)]), axis=normal
        ).circles()[0]
        _polyline(draw, camera, np.concatenate([ring, ring[:1]]), TOUCH, 2)
        # The normal points into the part: drawn from outside it ends at the patch.
        _polyline(draw, camera, np.stack([middle - NORMAL_M * normal, middle]), TOUCH, 2)
    return np.asarray(canvas.convert("RGB"))


def _veil(canvas: Image.Image, camera: Camera, space: AxisSpace) -> None:
    layer = Image.new("L", canvas.size, 0)
    draw = ImageDraw.Draw(layer)
    circles = space.circles()
    for pair in np.stack([circles[:-1], circles[1:]], 1):
        pixels, depths = camera.project(pair.reshape(-1, 3))
        if not depths.min() > NEAR_M:
            continue
        try:
            hull = pixels[ConvexHull(pixels).vertices]
        except QhullError:
            # The axis is known to a hair: its line alone shows it.
            continue
        draw.polygon([(float(x), float(y)) for x, y in hull], fill=VEIL)
    canvas.paste(Image.new("RGBA", canvas.size, (*AXIS, 255)), mask=layer)


def _arrow_head(draw: ImageDraw.ImageDraw, camera: Camera, centers: Array) -> None:
    """A head at the axis's positive end."""
    pixels, depths = camera.project(centers[[0, -1]])
    step = pixels[1] - pixels[0]
    length = float(np.linalg.norm(step))
    if not (depths.min() > NEAR_M and length > 1):
        return
    ahead = 9 * step / length
    side = np.array([-ahead[1], ahead[0]]) / 2
    corners = [pixels[1] + ahead, pixels[1] + side, pixels[1] - side]
    draw.polygon([(float(x), float(y)) for x, y in corners], fill=(*AXIS, 255))


def _polyline(
    draw: ImageDraw.ImageDraw, camera: Camera, points: Array, color: tuple[int, int, int], width: int
) -> None:
    pixels, depths = camera.project(points)
    for a, b, near in zip(pixels[:-1], pixels[1:], np.minimum(depths[:-1], depths[1:]), strict=True):
        if near > NEAR_M:
            draw.line([tuple(a), tuple(b)], fill=(*color, 255), width=width)
