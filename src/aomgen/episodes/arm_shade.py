"""The robot's shadow in the light from all around, beside the one that a lamp throws.

The robot is a few spheres: how much of the light a sphere keeps from a level place is known in closed form.
Source: Ren et al. 2006, "Real-time soft shadows in dynamic scenes using spherical harmonic exponentiation" (spheres
for bodies, what they let through multiplied).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from aomgen.core.mesh import sample_triangles
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.episodes.shading import DarkMaps, States
from aomgen.robots.robot import RobotModel
from aomgen.twin.plane_shadow import FILL, PlaneGrid
from aomgen.twin.twin import TwinModel, body_poses

# Cell of the map, [m], and how far around the robot's base it reaches.
CELL, REACH = 0.05, 1.3
# Points on each body from which its spheres are found, and the fewest in one.
POINTS, MIN_POINTS = 500, 20


class BodySphere(NamedTuple):
    """A sphere with the shadow of a piece of a body: middle (3,), body frame, and radius, [m]."""

    body: int
    middle: Array
    radius: float


def body_spheres(robot: RobotModel) -> list[BodySphere]:
    """Spheres along each body of a robot, one for every piece that is as long as the body is thick."""
    rng = np.random.default_rng(0)
    spheres = []
    for body in sorted({mesh.body for mesh in robot.meshes}):
        own = np.concatenate([m.vertices_body[m.faces] for m in robot.meshes if m.body == body])
        points = sample_triangles(own, POINTS, rng)
        # Axes by falling length.
        along = points @ np.linalg.eigh(np.cov(points.T))[1][:, ::-1]
        length, thickness = np.ptp(along, axis=0)[:2]
        pieces = max(1, round(length / thickness))
        place = np.floor((along[:, 0] - along[:, 0].min()) / length * pieces).clip(0, pieces - 1)
        for piece in range(pieces):
            chosen = points[place == piece]
            if len(chosen) < MIN_POINTS:
                continue
            # Seen from all sides, a convex body shows a quarter of its surface on the mean (Cauchy).
            radius = float(np.sqrt(ConvexHull(chosen, qhull_options="QJ").area / (4 * np.pi)))
            spheres.append(BodySphere(body, (chosen.min(0) + chosen.max(0)) / 2, radius))
    return spheres


class ArmShade:
    """How the robot's shadow differs from that at the scan: light may come back where the resting arm kept it away.

    The light is taken as even: which side more of it comes from changes little in what spheres keep away.

    Args:
        twin: With a lit object.
        robot: Whose arm moves.
        T_world_plane: The surface it falls on.
    """

    def __init__(self, twin: TwinModel, robot: RobotModel, T_world_plane: Array) -> None:
        self.T_world_plane = self.T_world_grid = T_world_plane
        self._to_plane, self._spheres = invert(T_world_plane), body_spheres(robot)
        lamp = twin.directional_light
        self._share = (1 - FILL) * (1.0 if lamp is None else 1 - lamp.share)
        cells = round(2 * REACH / CELL)
        self.grid = PlaneGrid(low=self._to_plane[:2, 3] - REACH, cell=CELL, columns=cells, rows=cells)
        self._scanned = self._taken(body_poses(twin, robot, twin.scan_state)[None])

    def dark(self, states: States) -> DarkMaps:
        """What it takes; less than nothing where the resting arm took it."""
        return DarkMaps(self.grid, self._taken(states.Ts_world_body) - self._scanned)

    def _taken(self, Ts_world_body: Array) -> NDArray[np.float32]:
        Ts = self._to_plane @ Ts_world_body
        passed = np.ones((len(Ts), self.grid.rows, self.grid.columns), np.float32)
        for body, middle, radius in self._spheres:
            # The twin's first body is the world.
            passed *= 1 - sphere_share(apply(Ts[:, 1 + body], middle), radius, self.grid)
        return np.float32(self._share) * (1 - passed)


def sphere_share(middles: Array, radius: float, grid: PlaneGrid) -> NDArray[np.float32]:
    """Share (T, rows, columns) of even light from above that a sphere keeps from cells; its middles (T, 3) lie above."""
    x, y, height = middles.T.astype(np.float32)[..., None]
    across, along = (
        (low + grid.cell * (np.arange(count, dtype=np.float32) + np.float32(0.5)) - place) ** 2
        for low, count, place in ((grid.low[0], grid.columns, x), (grid.low[1], grid.rows, y))
    )
    squared = (across + height**2)[:, None] + along[..., None]
    # The sphere covers pi (r/d)^2 h/d of the projected half sphere, which counts pi.
    return (
        (radius**2 * height[..., None].clip(0) / (squared * np.sqrt(squared))).clip(0, 1).astype(np.float32)
    )
