"""Shadows of an episode's robot and object on the table and on walls, in addition to the scanned shadows."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from aomgen.core.light import DirectionalLight, Light
from aomgen.core.mesh import sample_triangles
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.lighting.object_shadow import FILL, ObjectShadow
from aomgen.lighting.plane_shadow import PlaneGrid, measure_blocked_light, select_casters
from aomgen.lighting.wall_shadow import cast_wall_shadow
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import OBJECT, PART, TwinModel, body_poses, pose_bodies

# Number of sample points on walls and other objects at which the object's shadow is computed.
WALL_SAMPLES: Final = 2000
# Cell size of the map of the robot's shadow in soft light, and half side of the map around the robot's base, [m].
ARM_CELL, ARM_REACH = 0.05, 1.3
# Number of points on each body of the robot to which spheres are fitted, and smallest number of points for a sphere.
POINTS, MIN_POINTS = 500, 20


class States(NamedTuple):
    """Poses of the twin's bodies (T, B, 4, 4) and joint values of the object (T,) in T frames."""

    Ts_world_body: Array
    thetas: Array

    def part(self, frames: slice) -> "States":
        """Select a range of frames."""
        return States(self.Ts_world_body[frames], self.thetas[frames])


class TableShadow(NamedTuple):
    """A shadow on a surface.

    Attributes:
        T_world_plane: Pose of the surface (4, 4).
        prepare: Function that takes points (N, 3) on the surface, world frame, and returns a function from T states to the
            share (T, N) of the points' linear light that is blocked.
    """

    T_world_plane: Array
    prepare: Callable[[Array], Callable[[States], Array]]


def cast_shadows(
    twin: TwinModel,
    robot: RobotModel,
    Ts_world_body: Array,
    eyes_world: Array,
    table: ObjectShadow | None,
    T_world_plane: Array | None,
    threads: int | None,
) -> tuple[TwinModel, list[TableShadow]]:
    """Add a relit object's shadow to the walls of a twin, and prepare the shadows on its table.

    Args:
        twin, robot: See `render_episode`.
        Ts_world_body: Poses (B, 4, 4) of the twin's bodies in any state.
        eyes_world: Camera centers (K, 3).
        table: Visibility of light on the table past a relit object; None if there is no such object.
        T_world_plane: Pose of the table (4, 4); None if only the shadow of the directional light is required.
        threads: See `splatting.rasterizer.render`.
    """
    directional, shadows = twin.directional_light, []
    if directional is not None:
        casters = select_casters(twin, robot, new_object=table is not None)
        shadows.append(_cast_directional_shadow(directional, casters, threads))
    if table is None or T_world_plane is None:
        return twin, shadows
    light = twin.find_light(OBJECT)
    shadows.append(_cast_soft_shadow(twin, robot, light, Ts_world_body, table, T_world_plane))
    # The shadow on walls is computed for one state, because walls are closer to the object's static part than to its moving part.
    body = pose_bodies(twin.select(np.isin(twin.bodies, [twin.body(OBJECT), twin.body(PART)])), Ts_world_body)
    rows, sh = np.flatnonzero(twin.bodies == 0), np.array(twin.gaussians.sh)
    scene = twin.gaussians.select(rows)
    received = cast_wall_shadow(scene, body, light, directional, eyes_world, T_world_plane, WALL_SAMPLES)
    dark = np.flatnonzero(received < 1)
    sh[rows[dark]] = scene.select(dark).illuminate(received[dark]).sh
    return replace(twin, gaussians=twin.gaussians.with_sh(sh)), shadows


def _cast_directional_shadow(
    directional: DirectionalLight, casters: tuple[TwinModel, TwinModel], threads: int | None
) -> TableShadow:
    """Prepare the shadow of moving and new bodies in the directional light."""
    share, T_world_plane = float(directional.share.mean()), directional.T_world_plane

    def prepare(points: Array) -> Callable[[States], Array]:
        return lambda states: (
            share
            * measure_blocked_light(
                casters, states.Ts_world_body, T_world_plane, directional.directions, points, threads
            )
        )

    return TableShadow(T_world_plane, prepare)


def _cast_soft_shadow(
    twin: TwinModel,
    robot: RobotModel,
    light: Light,
    Ts_world_body: Array,
    table: ObjectShadow,
    T_world_plane: Array,
) -> TableShadow:
    """Prepare the shadow of a relit object and of the robot in all light except the directional light."""
    T_world_object, directional, share = Ts_world_body[twin.body(OBJECT)], twin.directional_light, 1.0
    if directional is not None:
        (light, _), share = directional.split(light), 1 - float(directional.share.mean())
    blocked = np.float32(share) * table.block(light, T_world_object)
    arm_grid, block_by_arm = _cast_arm_shadow(twin, robot, (1 - FILL) * share, T_world_plane)
    T_grid_world, to_plane = invert(T_world_object @ table.T_object_plane), invert(T_world_plane)

    def prepare(points: Array) -> Callable[[States], Array]:
        of_object = table.grid.lookup(apply(T_grid_world, points)[:, :2])
        of_arm = arm_grid.lookup(apply(to_plane, points)[:, :2])
        of_object.eliminate_zeros()

        def block(states: States) -> Array:
            maps = table.interpolate(blocked, states.thetas), block_by_arm(states.Ts_world_body)
            by_object, by_arm = (item.reshape(len(item), -1).T for item in maps)
            return (of_object @ by_object + of_arm @ by_arm).T

        return block

    return TableShadow(T_world_plane, prepare)


def _cast_arm_shadow(
    twin: TwinModel, robot: RobotModel, share: float, T_world_plane: Array
) -> tuple[PlaneGrid, Callable[[Array], NDArray[np.float32]]]:
    """Compute the change of the robot's soft shadow relative to the scan; the shadow of the scanned arm is removed.

    The robot is represented by spheres in uniform light; the share of light that a sphere blocks has a closed form.

    Args:
        twin, robot: Twin and its robot.
        share: Share of the light in which the shadow is cast.
        T_world_plane: Pose of the table (4, 4).

    Returns:
        Cells, and a function that computes maps (T, rows, columns) of the blocked share for body poses (T, B, 4, 4).

    Source: Ren et al. 2006, "Real-time soft shadows in dynamic scenes using spherical harmonic exponentiation".
    """
    to_plane, spheres = invert(T_world_plane), find_body_spheres(robot)
    cells = round(2 * ARM_REACH / ARM_CELL)
    grid = PlaneGrid(low=to_plane[:2, 3] - ARM_REACH, cell=ARM_CELL, columns=cells, rows=cells)

    def block(Ts_world_body: Array) -> NDArray[np.float32]:
        Ts = to_plane @ Ts_world_body
        passed = np.ones((len(Ts), cells, cells), np.float32)
        for body, center, radius in spheres:
            passed *= 1 - measure_sphere_share(apply(Ts[:, body], center), radius, grid)
        return np.float32(share) * (1 - passed)

    scanned = block(body_poses(twin, robot, twin.scan_state)[None])
    return grid, lambda Ts_world_body: block(Ts_world_body) - scanned


def find_body_spheres(robot: RobotModel) -> list[tuple[int, Array, float]]:
    """Fit spheres along each body of a robot, one for every segment whose length is the body's thickness.

    Returns:
        For each sphere, the body's index in the twin, the center (3,) in the body frame, and the radius, [m].
    """
    rng = np.random.default_rng(0)
    spheres = []
    for body in sorted({mesh.body for mesh in robot.meshes}):
        own = np.concatenate([m.vertices_body[m.faces] for m in robot.meshes if m.body == body])
        points = sample_triangles(own, POINTS, rng)
        # The principal axes are in the order of decreasing extent.
        along = points @ np.linalg.eigh(np.cov(points.T))[1][:, ::-1]
        length, thickness = np.ptp(along, axis=0)[:2]
        pieces = max(1, round(length / thickness))
        piece_of = np.floor((along[:, 0] - along[:, 0].min()) / length * pieces).clip(0, pieces - 1)
        for piece in range(pieces):
            chosen = points[piece_of == piece]
            if len(chosen) < MIN_POINTS:
                continue
            # Averaged over all directions, the projected area of a convex body is a quarter of its surface area (Cauchy).
            radius = float(np.sqrt(ConvexHull(chosen, qhull_options="QJ").area / (4 * np.pi)))
            # Body 0 of the twin is the world.
            spheres.append((1 + body, (chosen.min(0) + chosen.max(0)) / 2, radius))
    return spheres


def measure_sphere_share(centers: Array, radius: float, grid: PlaneGrid) -> NDArray[np.float32]:
    """Compute the share (T, rows, columns) of uniform light that a sphere blocks at each cell of a grid.

    Args:
        centers: Centers of the sphere (T, 3) in the frame of the grid, [m].
        radius: Radius of the sphere, [m].
        grid: Cells.
    """
    x, y, height = centers.T.astype(np.float32)[..., None]
    across, along = (
        (low + grid.cell * (np.arange(count, dtype=np.float32) + np.float32(0.5)) - center) ** 2
        for low, count, center in ((grid.low[0], grid.columns, x), (grid.low[1], grid.rows, y))
    )
    squared = (across + height**2)[:, None] + along[..., None]
    # In the projected hemisphere, whose area is pi, the sphere covers the area pi (r/d)^2 h/d.
    share = radius**2 * height[..., None].clip(0) / (squared * np.sqrt(squared))
    return share.clip(0, 1).astype(np.float32)
