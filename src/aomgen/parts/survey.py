"""Coverage of the sides of object, robot and table by the scan, in numbers and in words.

A view covers a point that is inside the image, faces the camera and is not behind the rendered surface.
Sides are named from the robot's viewpoint: the near side of the object faces the robot's base, left is
the robot's left when it looks at the object.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.boxes import find_upright_axes, fit_box
from aomgen.core.gaussians import Gaussians
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.parts import SOLID_OPACITY
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotConfiguration
from aomgen.splatting.surfaces import PARALLAX_DEG, ViewDepth

# Number of views that a depth requires: one, and two that confirm it.
MIN_VIEWS = 3
# Least cosine between the normal of a point and the direction to a view that covers it.
MIN_COSINE = 0.25
# Number of points along each edge of a side.
GRID = 12
# Their positions on the edge, -1..1: rims belong to the neighboring sides as well.
SPAN = np.linspace(-0.9, 0.9, GRID)
# Number of points on the robot's surface.
ROBOT_POINTS = 6000
# Share of covered points of a side below which a warning is given.
MIN_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Coverage of N points.

    Attributes:
        views: Number of views that cover each.
        spread_deg: Width of the cone around the mean direction that contains the directions to all these views,
            [deg]; 0 with less than two views.
    """

    views: Annotated[NDArray[np.uint16], "N"]
    spread_deg: Annotated[NDArray[np.float32], "N"]

    __post_init__ = freeze_arrays

    @property
    def enough(self) -> NDArray[np.bool_]:
        """Points (N,) whose depth the scan determines."""
        return (self.views >= MIN_VIEWS) & (self.spread_deg >= PARALLAX_DEG)


def compute_coverage(points: Array, views: list[ViewDepth], normals: Array | None = None) -> Coverage:
    """Compute the coverage of points (N, 3).

    Args:
        points: In the frame of the views' cameras.
        views: Depths of each view.
        normals: Unit outward directions (N, 3); without them every side counts.
    """
    seen = np.zeros((len(views), len(points)), bool)
    directions = np.zeros((len(views), len(points), 3), np.float32)
    for row, view in enumerate(views):
        rays = view.camera.center - points
        directions[row] = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        # NaN, outside the view, compares as False.
        seen[row] = view.behind(points) <= 1
        if normals is not None:
            seen[row] &= (directions[row] * normals).sum(1) > MIN_COSINE
    middle = np.einsum("vn,vnk->nk", seen.astype(np.float32), directions)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    cosines = np.where(seen, np.einsum("vnk,nk->vn", directions, middle), 1.0).min(0, initial=1.0)
    return Coverage(views=seen.sum(0), spread_deg=2 * np.degrees(np.arccos(np.clip(cosines, -1, 1))))


# One side of an object: its name, points (M, 3) [m] on it and outward normals (M, 3), world frame.
Side = tuple[str, Array, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Coverage of points [m] on all sides; `sides`: index into `names` of each."""

    names: tuple[str, ...]
    points_world: Annotated[Array, "M 3"]
    sides: Annotated[NDArray[np.int32], "M"]
    coverage: Coverage

    __post_init__ = freeze_arrays

    def figures(self) -> dict[str, dict[str, float]]:
        """Compute by side the median number of views and spread, and the share of points with enough of both."""
        result = {}
        for index, name in enumerate(self.names):
            mine = self.sides == index
            result[name] = {
                "views": float(np.median(self.coverage.views[mine])),
                "spread_deg": round(float(np.median(self.coverage.spread_deg[mine])), 1),
                "share": round(float(self.coverage.enough[mine].mean()), 3),
            }
        return result

    def warnings(self) -> list[str]:
        """List a sentence for every side that the scan does not determine."""
        sentences = []
        for name, seen in self.figures().items():
            if seen["share"] >= MIN_SHARE:
                continue
            views, spread = round(seen["views"]), seen["spread_deg"]
            if views < MIN_VIEWS:
                found = f"is covered by {views} view{'' if views == 1 else 's'}, expected {MIN_VIEWS}"
            elif spread < PARALLAX_DEG:
                found = f"is covered from one direction (over {spread:.0f} deg, expected {PARALLAX_DEG:.0f})"
            else:
                found = f"is covered to {100 * seen['share']:.0f} % only"
            sentences.append(f"{name} {found}; its surface is guessed, add scan images that show it")
        return sentences


def survey(
    gaussians_world: Gaussians,
    labels: NDArray[np.uint8],
    configuration: RobotConfiguration,
    views: list[ViewDepth],
    rng: np.random.Generator,
) -> Survey:
    """Measure the coverage of the sides of object, robot and table.

    Args:
        gaussians_world, labels: The scene, [m], and the part of each Gaussian (N,).
        configuration: Robot as scanned.
        views: Depths of the training views, world frame.
        rng: Samples points on the robot.
    """
    ours = np.isin(labels, (STATIC, MOVING)) & (gaussians_world.opacities > SOLID_OPACITY)
    points = np.asarray(gaussians_world.means[ours], np.float64)
    forward = _forward(points)
    sides = [*list_object_sides(points, forward), *list_table_sides(points, forward)]
    sides += list_robot_sides(configuration, forward, rng)
    points = np.concatenate([own for _, own, _ in sides])
    normals = np.concatenate([own for _, _, own in sides])
    return Survey(
        names=tuple(name for name, _, _ in sides),
        points_world=points,
        sides=np.repeat(np.arange(len(sides)), [len(own) for _, own, _ in sides]),
        coverage=compute_coverage(points, views, normals),
    )


def list_object_sides(points: Array, forward: Array) -> list[Side]:
    """List four sides and the top of the upright box around an object.

    Args:
        points: On the object (N, 3), world frame, [m].
        forward: Level unit direction (2,) from the robot to it.
    """
    box = fit_box(points, find_upright_axes(points))
    words = {"near": "near side", "far": "far side", "left": "left side", "right": "right side"}
    grid = _grid(SPAN, SPAN)
    sides = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, 1.0)):
        normal = sign * box.T_world_box[:3, axis]
        word = "top" if axis == 2 else words[_bearing(normal[:2], forward)]
        points = apply(box.T_world_box, np.insert(grid, axis, sign, axis=1) * box.half_extents)
        normals = np.tile(normal, (len(grid), 1))
        sides.append((f"the {word} of the object", points, normals))
    return sides


def list_table_sides(points: Array, forward: Array) -> list[Side]:
    """List the support around an object, in a band half as wide as the object's box; see `list_object_sides`."""
    box = fit_box(points, find_upright_axes(points))
    half = box.half_extents
    words = {"near": "before", "far": "behind", "left": "left of", "right": "right of"}
    across, outward = _grid(SPAN, np.linspace(0.1, 1.0, GRID)).T
    sides = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        local = np.full((len(across), 3), -half[2])
        local[:, axis] = sign * (half[axis] + float(np.linalg.norm(half[:2])) * outward)
        local[:, 1 - axis] = half[1 - axis] * across
        word = words[_bearing(sign * box.T_world_box[:2, axis], forward)]
        normals = np.tile([0.0, 0.0, 1.0], (len(local), 1))
        sides.append((f"the table {word} the object", apply(box.T_world_box, local), normals))
    return sides


def list_robot_sides(
    configuration: RobotConfiguration, forward: Array, rng: np.random.Generator
) -> list[Side]:
    """List four sides and the top of the robot in its configuration, without undersides, which the table hides.

    Args:
        configuration: Robot as scanned.
        forward: Level unit direction (2,) from it to the object.
        rng: Samples points on the meshes.
    """
    robot = configuration.robot
    poses = robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    triangles_world = [
        apply(poses[mesh.body], mesh.vertices_body)[mesh.faces].reshape(-1, 3) for mesh in robot.meshes
    ]
    corners = np.concatenate(triangles_world)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    points, chosen, _ = sample_surface(corners, triangles, ROBOT_POINTS, rng)
    directions = face_normals_areas(corners, triangles)[0][chosen]
    words = {"near": "back", "far": "front", "left": "left side", "right": "right side"}
    steep = np.abs(directions[:, 2]) > np.sqrt(0.5)
    kinds = np.array([_bearing(direction, forward) for direction in directions[:, :2]])
    sides = [("top", steep & (directions[:, 2] > 0))]
    sides += [(word, ~steep & (kinds == kind)) for kind, word in words.items()]
    return [
        (f"the {word} of the robot", points[which], directions[which]) for word, which in sides if which.any()
    ]


def _grid(first: NDArray, second: NDArray) -> Array:
    """List all pairs (N, 2) of two rows of numbers."""
    return np.stack(np.meshgrid(first, second), -1).reshape(-1, 2)


def _forward(points: Array) -> Array:
    """Compute the level unit direction (2,) from the robot's base to points, +x where they are above it."""
    middle = np.median(points[:, :2], axis=0)
    length = float(np.linalg.norm(middle))
    return middle / length if length > 1e-6 else np.array([1.0, 0.0])


def _bearing(direction: Array, forward: Array) -> str:
    """Name a level direction (2,) relative to the viewing direction `forward` (2,)."""
    along = float(direction @ forward)
    across = float(direction @ [-forward[1], forward[0]])
    if abs(along) >= abs(across):
        return "far" if along > 0 else "near"
    return "left" if across > 0 else "right"
