"""Coverage of the sides of object, robot and table by the scan, in numbers and in words.

Sides are named as the robot sees them: the near side of the object faces the robot's base, left is
the robot's left when it looks at the object.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, STATIC
from aomgen.core.boxes import QUANTILES, find_upright_axes
from aomgen.core.gaussians import Gaussians
from aomgen.core.mesh import face_normals_areas, sample_surface
from aomgen.core.part_points import SOLID_OPACITY
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.parts.coverage import MIN_VIEWS, Coverage, coverage_of
from aomgen.robots.robot import RobotConfiguration
from aomgen.splatting.surfaces import PARALLAX_DEG, ViewDepth

# Points along each edge of a side.
GRID = 12
# Points on the robot's surface.
ROBOT_POINTS = 6000
# A side counts as seen when at least this share of its points is.
MIN_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One side of a thing: its name, points (M, 3) [m] on it and outward normals (M, 3), world frame."""

    name: str
    points: Array
    normals: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Coverage of all sides.

    Attributes:
        names: Of the sides.
        points_world: Points on all sides (M, 3), [m].
        sides: Index into `names` of each point (M,).
        coverage: Of each point.
    """

    names: tuple[str, ...]
    points_world: Annotated[Array, "M 3"]
    sides: Annotated[NDArray[np.int32], "M"]
    coverage: Coverage

    __post_init__ = freeze_arrays

    def figures(self) -> dict[str, dict[str, float]]:
        """By side: median number of views and spread, and the share of points that were seen enough."""
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
        """A sentence for every side that the scan does not decide."""
        sentences = []
        for name, seen in self.figures().items():
            if seen["share"] >= MIN_SHARE:
                continue
            views, spread = round(seen["views"]), seen["spread_deg"]
            if views < MIN_VIEWS:
                found = f"was seen by {views} view{'' if views == 1 else 's'}, want {MIN_VIEWS}"
            elif spread < PARALLAX_DEG:
                found = f"was seen from one direction (over {spread:.0f} deg, want {PARALLAX_DEG:.0f})"
            else:
                found = f"was seen to {100 * seen['share']:.0f} % only"
            sentences.append(f"{name} {found}; what is there is guessed, add scan images that show it")
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
        gaussians_world: The scene, [m].
        labels: Part of each Gaussian (N,).
        configuration: Robot as scanned.
        views: What the training views see, world frame.
        rng: Spreads points over the robot.
    """
    ours = np.isin(labels, (STATIC, MOVING)) & (gaussians_world.opacities > SOLID_OPACITY)
    points = np.asarray(gaussians_world.means[ours], np.float64)
    forward = _forward(points)
    sides = [*object_sides(points, forward), *table_sides(points, forward)]
    sides += robot_sides(configuration, forward, rng)
    places = np.concatenate([side.points for side in sides])
    normals = np.concatenate([side.normals for side in sides])
    return Survey(
        names=tuple(side.name for side in sides),
        points_world=places,
        sides=np.repeat(np.arange(len(sides)), [len(side.points) for side in sides]),
        coverage=coverage_of(places, views, normals),
    )


def object_sides(points: Array, forward: Array) -> list[Side]:
    """Four sides and the top of the upright box around an object.

    Args:
        points: On the object (N, 3), world frame, [m].
        forward: Level unit direction (2,) in which the robot looks at it.
    """
    R, low, high = _box(points)
    words = {"near": "near side", "far": "far side", "left": "left side", "right": "right side"}
    middle, half = (low + high) / 2, (high - low) / 2
    # The rims belong to the neighbouring sides as well.
    grid = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, GRID)] * 2), -1).reshape(-1, 2)
    result = []
    for axis in (0, 1, 2):
        for sign in (-1.0, 1.0):
            if axis == 2 and sign < 0:
                continue
            local = np.zeros((len(grid), 3))
            local[:, axis] = sign
            local[:, [k for k in range(3) if k != axis]] = grid
            normal = np.zeros(3)
            normal[axis] = sign
            turned = np.append(R @ normal[:2], normal[2])
            word = "top" if axis == 2 else words[_bearing(turned[:2], forward)]
            places = middle + local * half
            places[:, :2] = places[:, :2] @ R.T
            normals = np.tile(turned, (len(grid), 1))
            result.append(Side(name=f"the {word} of the object", points=places, normals=normals))
    return result


def table_sides(points: Array, forward: Array) -> list[Side]:
    """The surface on which an object stands, in a band around it half as wide as the object's box.

    Args:
        points: On the object (N, 3), world frame, [m].
        forward: Level unit direction (2,) in which the robot looks at it.
    """
    R, low, high = _box(points)
    words = {"near": "before", "far": "behind", "left": "left of", "right": "right of"}
    reach = 0.5 * float(np.linalg.norm(high[:2] - low[:2]))
    across, outward = np.meshgrid(np.linspace(0.05, 0.95, GRID), np.linspace(0.1, 1.0, GRID))
    result = []
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            local = np.empty((GRID * GRID, 2))
            edge = high[axis] if sign > 0 else low[axis]
            local[:, axis] = edge + sign * reach * outward.reshape(-1)
            other = 1 - axis
            local[:, other] = low[other] + (high[other] - low[other]) * across.reshape(-1)
            word = words[_bearing(sign * R[:, axis], forward)]
            places = np.column_stack([local @ R.T, np.full(len(local), low[2])])
            normals = np.tile([0.0, 0.0, 1.0], (len(local), 1))
            result.append(Side(name=f"the table {word} the object", points=places, normals=normals))
    return result


def robot_sides(configuration: RobotConfiguration, forward: Array, rng: np.random.Generator) -> list[Side]:
    """Four sides and the top of the posed robot; undersides, which no table lets be seen, are left out.

    Args:
        configuration: Robot as scanned.
        forward: Level unit direction (2,) in which it looks at the object.
        rng: Spreads points over the meshes.
    """
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    areas = [
        face_normals_areas(mesh.vertices_body, mesh.faces)[1].sum() for mesh in configuration.robot.meshes
    ]
    points, normals = [], []
    for mesh, area in zip(configuration.robot.meshes, areas, strict=True):
        count = round(ROBOT_POINTS * area / sum(areas))
        if count:
            vertices = apply(poses[mesh.body], mesh.vertices_body)
            sampled, faces, _ = sample_surface(vertices, mesh.faces, count, rng)
            points.append(sampled)
            normals.append(face_normals_areas(vertices, mesh.faces)[0][faces])
    places, directions = np.concatenate(points), np.concatenate(normals)
    words = {"near": "back", "far": "front", "left": "left side", "right": "right side"}
    steep = np.abs(directions[:, 2]) > np.sqrt(0.5)
    kinds = np.array([_bearing(direction, forward) for direction in directions[:, :2]])
    chosen = [("top", steep & (directions[:, 2] > 0))]
    chosen += [(word, ~steep & (kinds == kind)) for kind, word in words.items()]
    return [
        Side(name=f"the {word} of the robot", points=places[which], normals=directions[which])
        for word, which in chosen
        if which.any()
    ]


def _box(points: Array) -> tuple[Array, Array, Array]:
    """Level axes (2, 2) of the upright box around points, and its corners in them."""
    R = find_upright_axes(points)[:2, :2]
    local = np.column_stack([points[:, :2] @ R, points[:, 2]])
    low, high = np.quantile(local, QUANTILES, axis=0)
    return R, low, high


def _forward(points: Array) -> Array:
    """Level unit direction (2,) from the robot's base to points, +x where they are above it."""
    middle = np.median(points[:, :2], axis=0)
    length = float(np.linalg.norm(middle))
    return middle / length if length > 1e-6 else np.array([1.0, 0.0])


def _bearing(direction: Array, forward: Array) -> str:
    """Where a level direction (2,) points, for who looks `forward` (2,)."""
    along = float(direction @ forward)
    across = float(direction @ [-forward[1], forward[0]])
    if abs(along) >= abs(across):
        return "far" if along > 0 else "near"
    return "left" if across > 0 else "right"
