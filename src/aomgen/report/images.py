"""Images of the report: outlines, label colors, lines and sheets, and comparisons of recording and reconstruction."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, binary_erosion

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.motion import MotionEstimate
from aomgen.core.structure import held_out
from aomgen.core.transforms import apply, make_tangent_basis
from aomgen.core.values import Array
from aomgen.io.artifact import load_artifact
from aomgen.io.images import fill_hull, read_image, resize
from aomgen.io.video import probe_video, read_frames
from aomgen.parts.stage import COVERAGE
from aomgen.parts.survey import Survey
from aomgen.pipeline.rendering import render_twin
from aomgen.results import Results
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.twin.twin import TwinState

# sRGB: blue, orange, pink.
LABEL_COLORS = {ROBOT: (64, 128, 255), STATIC: (255, 176, 32), MOVING: (230, 60, 120)}
# A color that is rare in scenes.
OUTLINE = (255, 60, 200)
Image8 = NDArray[np.uint8]
AXIS, PATH, TOUCH = (40, 220, 255), (255, 80, 60), (255, 230, 60)
# Opacity of the region that contains the axis, over the image, 0..255.
VEIL = 110
STATIONS, SIDES = 9, 24
# Width of a top view and of an image in a sheet, [px]; number of images in a row of a sheet.
MAP_PX, SMALL_PX, COLUMNS = 520, 320, 4
# Least distance of drawn points from the camera, [m].
NEAR_M = 0.05
# Colors of points that are visible in no view, in few views and in enough views, sRGB.
SEEN = np.array([(205, 45, 45), (235, 180, 40), (60, 150, 90)], np.uint8)
# Least radius of a drawn contact (a finger pad), and length of its normal (a finger), [m].
PATCH_M, NORMAL_M = 0.008, 0.05


def overlay_outline(image: Image8, mask: NDArray[np.bool_], color: tuple[int, int, int]) -> Image8:
    """Draw the outline of a mask, two pixels wide, over an image (H, W, 3)."""
    result = image.copy()
    result[np.asarray(binary_dilation(mask)) & ~np.asarray(binary_erosion(mask))] = color
    return result


def overlay_labels(image: Image8, labels: NDArray[np.uint8]) -> Image8:
    """Draw part labels (H, W) as half transparent colors over an image (H, W, 3)."""
    result = image.astype(np.float32)
    for label, color in LABEL_COLORS.items():
        mask = labels == label
        result[mask] = 0.5 * result[mask] + 0.5 * np.array(color, np.float32)
    return result.astype(np.uint8)


def sheet(images: list[Image8], columns: int, *, gap: int = 4) -> Image8:
    """Arrange images of one size in rows."""
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    canvas = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        top, left = row * (height + gap), column * (width + gap)
        canvas[top : top + height, left : left + width] = image
    return canvas


def map_from_above(points_world: NDArray, colors_srgb: NDArray[np.uint8], cameras: list[Camera]) -> Image8:
    """Draw points (N, 3) with colors (N, 3) and camera positions in a top view, with the robot's base at the bottom.

    The robot's x axis points up in the image. Lower points are drawn first.
    """
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    ahead = np.array([camera.T_world_cam[:3, 2] for camera in cameras]).reshape(-1, 3)
    everything = np.concatenate([points_world, centers, np.zeros((1, 3))])[:, :2]
    low, high = everything.min(0) - 0.15, everything.max(0) + 0.15
    scale = MAP_PX / (high[1] - low[1])

    def px(places: NDArray) -> list[tuple[float, float]]:
        return [((high[1] - y) * scale, (high[0] - x) * scale) for x, y in places[:, :2]]

    canvas = Image.new("RGB", (MAP_PX, round((high[0] - low[0]) * scale)), (250, 251, 252))
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


def draw_circles(centers: Array, radii: Array, axis: Array) -> Array:
    """Compute points (K, SIDES, 3) on circles about a unit axis (3,), with centers (K, 3) and radii (K,)."""
    first, second = make_tangent_basis(axis)
    turns = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    ring = np.outer(np.cos(turns), first) + np.outer(np.sin(turns), second)
    return centers[:, None] + radii[:, None, None] * ring


def axis_space(motion: MotionEstimate, held_world: Array) -> tuple[Array, Array]:
    """Compute the 95 % region of an axis as centers (K, 3) and circles (K, SIDES, 3), [m].

    For a revolute joint, the radius of the region next to the held point is the uncertainty of the axis position; it
    increases to both sides with the uncertainty of the direction. For a prismatic joint, the region is a cone from the
    initial held point (3,) to its final position.
    """
    joint = motion.joint
    if joint.type == "prismatic":
        along, start, waist = np.linspace(0, joint.upper, STATIONS), held_world, 0.0
    else:
        start = joint.origin + ((held_world - joint.origin) @ joint.axis) * joint.axis
        reach = 0.7 * float(np.linalg.norm(held_world - start))
        along, waist = np.linspace(-reach, reach, STATIONS), motion.origin_ci95_m
    radii = waist + np.abs(along) * np.tan(min(motion.axis_ci95_rad, 1.2))
    centers = start + along[:, None] * joint.axis
    return centers, draw_circles(centers, radii, joint.axis)


def overlay_motion(
    image_srgb: Image8, camera: Camera, motion: MotionEstimate, held_world: Array, theta: float
) -> Image8:
    """Draw the axis with its 95 % region, the path of the held point and the contact patches over a frame (H, W, 3).

    Args:
        held_world: Held point (3,) at the start of the motion, [m].
        theta: Joint value at the frame; the patches move with the part.
    """
    canvas = Image.fromarray(image_srgb).convert("RGBA")
    centers, circles = axis_space(motion, held_world)
    _veil(canvas, camera, circles)
    draw = ImageDraw.Draw(canvas)
    joint = motion.joint
    values = np.linspace(joint.lower, joint.upper, 40)
    _polyline(draw, camera, apply(joint.motion(values), held_world), PATH)
    _polyline(draw, camera, centers, AXIS)
    _arrow_head(draw, camera, centers)
    carried = joint.motion(theta)
    for patch in motion.contacts:
        middle, normal = apply(carried, patch.point), carried[:3, :3] @ patch.normal
        ring = draw_circles(middle[None], np.array([max(patch.spread_m, PATCH_M)]), normal)[0]
        _polyline(draw, camera, np.concatenate([ring, ring[:1]]), TOUCH)
        # The normal points into the part; it is drawn outside of the part and ends at the patch.
        _polyline(draw, camera, np.stack([middle - NORMAL_M * normal, middle]), TOUCH)
    return np.asarray(canvas.convert("RGB"))


def _veil(canvas: Image.Image, camera: Camera, circles: Array) -> None:
    covered = np.zeros((canvas.height, canvas.width), bool)
    for pair in np.stack([circles[:-1], circles[1:]], 1):
        pixels, depths = camera.project(pair.reshape(-1, 3))
        if depths.min() > NEAR_M:
            covered |= fill_hull(pixels, canvas.width, canvas.height)
    layer = Image.fromarray(np.where(covered, VEIL, 0).astype(np.uint8))
    canvas.paste(Image.new("RGBA", canvas.size, (*AXIS, 255)), mask=layer)


def _arrow_head(draw: ImageDraw.ImageDraw, camera: Camera, centers: Array) -> None:
    """Draw an arrow head at the positive end of the axis."""
    pixels, depths = camera.project(centers[[0, -1]])
    step = pixels[1] - pixels[0]
    length = float(np.linalg.norm(step))
    if not (depths.min() > NEAR_M and length > 1):
        return
    ahead = 9 * step / length
    side = np.array([-ahead[1], ahead[0]]) / 2
    corners = [pixels[1] + ahead, pixels[1] + side, pixels[1] - side]
    draw.polygon([(float(x), float(y)) for x, y in corners], fill=(*AXIS, 255))


def _polyline(draw: ImageDraw.ImageDraw, camera: Camera, points: Array, color: tuple[int, int, int]) -> None:
    pixels, depths = camera.project(points)
    for a, b, near in zip(pixels[:-1], pixels[1:], np.minimum(depths[:-1], depths[1:]), strict=True):
        if near > NEAR_M:
            draw.line([tuple(a), tuple(b)], fill=(*color, 255), width=2)


def choose_recorded_frames(results: Results, count: int) -> list[int]:
    """Return frame numbers evenly distributed over the recorded video."""
    frames = len(results.videos[results.demo_camera].times_s)
    return [int(frame) for frame in np.linspace(0, frames - 1, count)]


def estimate_recorded_states(results: Results, frames: list[int]) -> tuple[TwinState, ...]:
    """Return the estimated states of the twin at frames of the recorded video."""
    times_s = results.videos[results.demo_camera].times_s[frames]
    return results.states_at(times_s, results.twin.T_world_object)


def heldout_sheet(results: Results) -> Image8:
    """Arrange held-out scan images above renderings of the twin from the same camera poses."""
    cameras = results.scan_cameras
    names = [name for name in held_out(list(results.scan_images)) if name in cameras]
    picked = [names[i] for i in np.linspace(0, len(names) - 1, min(COLUMNS, len(names))).astype(int)]
    real = [_small(read_image(results.scan_images[name])) for name in picked]
    drawn = [
        _small(render_twin(results.twin, results.robot, cameras[name], results.twin.scan_state)[0])
        for name in picked
    ]
    return sheet(real + drawn, len(picked))


def parts_sheet(results: Results) -> Image8:
    """Draw the part labels of the Gaussians over scan images."""
    cameras = results.scan_cameras
    names = sorted(cameras)
    picked = [names[i] for i in np.linspace(0, len(names) - 1, COLUMNS + 2).astype(int)[1:-1]]
    images = []
    for name in picked:
        labels = render_twin(results.twin, results.robot, cameras[name], results.twin.scan_state)[2]
        images.append(_small(overlay_labels(read_image(results.scan_images[name]), labels)))
    return sheet(images, len(images))


def coverage_map(results: Results) -> Image8:
    """Draw the sides of object, robot and table in a top view: red for no view, yellow for few, green for enough."""
    found = load_artifact(results.folders["parts"], COVERAGE, Survey)
    seen = np.where(found.coverage.enough, 2, np.where(found.coverage.views > 0, 1, 0))
    cameras = results.scan_cameras
    withheld = held_out(list(results.scan_images))
    training = [camera for name, camera in cameras.items() if name not in withheld]
    return map_from_above(found.points_world, SEEN[seen], training)


def robot_sheet(results: Results) -> Image8:
    """Draw the outline of the robot model over the video, at the estimated clock offset and camera."""
    images = []
    video, frames = results.videos[results.demo_camera], choose_recorded_frames(results, COLUMNS)
    height, width = video.frames_srgb.shape[1:3]
    with SilhouetteRenderer(results.robot, max_width=width, max_height=height) as renderer:
        for frame, state in zip(frames, estimate_recorded_states(results, frames), strict=True):
            bodies, _ = renderer.draw(results.fixed_camera.camera, state.joints, state.gripper)
            images.append(_small(overlay_outline(video.frames_srgb[frame], bodies >= 0, OUTLINE)))
    return sheet(images, COLUMNS)


def replay_sheet(results: Results) -> Image8:
    """Arrange video frames above the replay of the twin."""
    states = estimate_recorded_states(results, choose_recorded_frames(results, COLUMNS))
    camera = results.fixed_camera.camera
    drawn = [_small(render_twin(results.twin, results.robot, camera, state)[0]) for state in states]
    return sheet(demo_strip(results, COLUMNS) + drawn, COLUMNS)


def demo_strip(results: Results, count: int) -> list[Image8]:
    """Return frames of the recorded demonstration."""
    video = results.videos[results.demo_camera]
    return [_small(video.frames_srgb[frame]) for frame in choose_recorded_frames(results, count)]


def episode_strip(folder: Path, camera: str, count: int) -> list[Image8]:
    """Return frames of one committed episode from one camera."""
    path = folder / f"{camera}.mp4"
    return read_frames(path, [int(i) for i in np.linspace(0, probe_video(path).frames - 1, count)])


def _small(image: Image8) -> Image8:
    return resize(image, SMALL_PX, round(image.shape[0] * SMALL_PX / image.shape[1]))
