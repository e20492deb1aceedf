"""Moving the drawn robot onto the outlines that many images show, all views at once.

Gauss-Newton over the seven parameters of a similarity; see `contours` for the evidence.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, similarity_parts
from aomgen.core.values import Array, freeze
from aomgen.io.images import resize
from aomgen.physics.robot import RobotModel
from aomgen.physics.silhouette import SilhouetteRenderer
from aomgen.reconstruction.contours import (
    Contour,
    View,
    color_ratio,
    edge_shifts,
    outline,
    region_shifts,
    shift_jacobian,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotPosture:
    """The robot during the scan: model, joints (J,) [rad] and gripper 0..1."""

    robot: RobotModel
    joints: Array
    gripper: float

    def __post_init__(self) -> None:
        freeze(self, "joints", self.joints, (None,))

    def points_world(self, count: int = 3000) -> Array:
        """About `count` vertices (V, 3) of the posed robot, [m]."""
        poses = self.robot.link_poses(self.joints[None], self.gripper)[0]
        total = sum(len(mesh.vertices_body) for mesh in self.robot.meshes)
        step = max(1, total // count)
        return np.concatenate([apply(poses[m.body], m.vertices_body[::step]) for m in self.robot.meshes])

    @property
    def ee_world(self) -> Array:
        """End effector position (3,), [m]."""
        return self.robot.ee_poses(self.joints[None])[0, :3, 3]


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One setting of the refinement: image width [px], search reach [px], iterations, evidence."""

    width: int
    reach: int
    iterations: int
    edges: bool


COARSE = (Level(width=160, reach=16, iterations=10, edges=False),)
MIDDLE = (Level(width=320, reach=12, iterations=6, edges=False),)
FINE = (
    Level(width=320, reach=8, iterations=4, edges=False),
    Level(width=640, reach=8, iterations=5, edges=False),
    Level(width=640, reach=4, iterations=6, edges=True),
)


def camera_in_world(S_world_recon: Array, camera_recon: Camera) -> Camera:
    """A camera of the recon frame as a camera of the world, same pixels."""
    _, R, _ = similarity_parts(S_world_recon)
    T = np.eye(4)
    T[:3, :3] = R @ camera_recon.T_world_cam[:3, :3]
    T[:3, 3] = apply(S_world_recon, camera_recon.center)
    return camera_recon.moved(T)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotDrawing:
    renderer: SilhouetteRenderer
    posture: RobotPosture

    def contour(self, camera: Camera, limit: int) -> tuple[Contour, NDArray[np.bool_]] | None:
        """Outline and mask, or None when too little robot is in the picture."""
        bodies, depth = self.renderer.draw(camera, self.posture.joints, self.posture.gripper)
        mask = bodies >= 0
        if not 0.002 < mask.mean() < 0.7:
            return None
        contour = outline(camera, mask, depth, limit)
        return (contour, mask) if len(contour.pixels) >= 20 else None


def refine(
    S: Array, views: list[View], drawing: RobotDrawing, levels: tuple[Level, ...], contour_points: int
) -> Array:
    for level in levels:
        resized = [reduced(view, level.width) for view in views]
        grays = [gray_levels(view.image_srgb) for view in resized]
        for _ in range(level.iterations):
            A, b = _normal_equations(S, resized, grays, drawing, level, contour_points)
            step = np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(7) + 1e-9 * np.eye(7), b)
            S = _moved(S, step, drawing.posture)
            if np.linalg.norm(step[3:6]) < 2e-5 and np.linalg.norm(step[:3]) < 2e-5:
                break
    return S


def _normal_equations(
    S: Array,
    views: list[View],
    grays: list[NDArray[np.float32]],
    drawing: RobotDrawing,
    level: Level,
    contour_points: int,
) -> tuple[Array, Array]:
    A, b = np.zeros((7, 7)), np.zeros(7)
    pivot = drawing.posture.points_world().mean(0)
    for view, gray in zip(views, grays, strict=True):
        camera = camera_in_world(S, view.camera_recon)
        drawn = drawing.contour(camera, contour_points)
        if drawn is None:
            continue
        contour, mask = drawn
        if level.edges:
            shifts, strength = edge_shifts(contour, gray, level.reach)
            weights = np.minimum(strength / 0.05, 1.0) / (1 + (shifts / 1.0) ** 2) ** 2
        else:
            ratio = color_ratio(view.image_srgb, mask, 2 * level.reach)
            shifts, variances = region_shifts(contour, ratio, level.reach)
            weights = 1 / (variances + 0.5) / (1 + (shifts / (0.5 * level.reach)) ** 2)
        J = shift_jacobian(camera, contour, pivot)
        A += J.T @ (weights[:, None] * J)
        b += J.T @ (weights * shifts)
    return A, b


def _moved(S: Array, step: Array, posture: RobotPosture) -> Array:
    """The similarity after the robot was found to sit `step` away from where it was drawn."""
    pivot = posture.points_world().mean(0)
    step = np.concatenate([np.clip(step[:6], -0.2, 0.2), np.clip(step[6:], -0.15, 0.15)])
    scale, R = float(np.exp(step[6])), matrix_from_rotvec(step[:3])
    D = similarity(scale, R, pivot + step[3:6] - scale * R @ pivot)
    return np.linalg.inv(D) @ S


def spread(views: list[View], S: Array, drawing: RobotDrawing, count: int) -> list[View]:
    """Views that show the robot well, chosen far from one another by viewing direction."""
    robot = drawing.posture.points_world(300)
    target = robot.mean(0)
    usable, directions = [], []
    for view in views:
        camera = camera_in_world(S, view.camera_recon)
        pixels, depths = camera.project(robot)
        size = np.array([camera.width, camera.height])
        inside = (depths > 0.05) & np.all((pixels > 0) & (pixels < size), 1)
        if inside.mean() > 0.3 and np.prod(np.ptp(pixels[inside], axis=0)) > 0.02 * np.prod(size):
            offset = camera.center - target
            usable.append(view)
            directions.append(offset / np.linalg.norm(offset))
    if len(usable) <= count:
        return usable
    points = np.array(directions)
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return [usable[i] for i in sorted(chosen)]


def reduced(view: View, width: int) -> View:
    """The view at most `width` pixels wide."""
    return scaled(view, min(1.0, width / view.camera_recon.width))


def scaled(view: View, scale: float) -> View:
    if scale == 1.0:
        return view
    width = round(view.camera_recon.width * scale)
    height = round(view.camera_recon.height * scale)
    return View(
        name=view.name,
        camera_recon=view.camera_recon.resized(width, height),
        image_srgb=resize(view.image_srgb, width, height),
    )


def gray_levels(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    gray = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return (gray / 255).astype(np.float32)
