"""Images of an episode from fixed cameras, by the twin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import concatenate
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import RigidParts
from aomgen.splatting.session import RenderSession, draw_sessions
from aomgen.twin.plane_shadow import PlaneGrid, SoftShadow, cast_on_plane, cast_soft_shadow
from aomgen.twin.shadow import FAR, MOVES, STANDS, intersect_surface, silhouette
from aomgen.twin.twin import (
    OBJECT,
    PART,
    StaticLayer,
    Twin,
    moving_layer,
    posed_by,
    shadow_roles,
    static_layer,
    trajectory_body_poses,
)

# Frames that are drawn at once; bounds the memory of their colors and shades.
BATCH: Final = 32
# Cell of a map of the arm's crisp shadow, [m]: about a pixel.
CRISP_CELL: Final = 0.004
# Colors darker than this have no share to speak of, 0..1.
DARK: Final = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """What moves in the images, T frames.

    Attributes:
        joints: Of the arm, [rad].
        gripper: 0..1.
        thetas: Joint value of the object, [rad] or [m].
        T_world_object: Object pose.
    """

    joints: Annotated[Array, "T _"]
    gripper: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    T_world_object: Matrix4

    __post_init__ = freeze_arrays


def static_layers(
    twin: Twin, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """What each camera sees of the scene that never moves; the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}


def render_frames(
    twin: Twin,
    robot: RobotModel,
    trajectory: Trajectory,
    layers: Mapping[str, StaticLayer],
    T_world_plane: Array | None = None,
    threads: int | None = None,
    *,
    soft: SoftShadow | None = None,
) -> dict[str, NDArray[np.uint8]]:
    """Draw an episode: frames (T, H, W, 3) uint8 of each camera.

    Args:
        twin: With the object that stands in it.
        layers: From `static_layers`, of the same twin.
        T_world_plane: The surface that the object's shadow falls on; None for no shadow.
        threads: As in `splatting.rasterizer.render`.
        soft: From `cast_soft_shadow`, of the same twin and surface; None to find it here.
    """
    Ts = trajectory_body_poses(
        twin, robot, trajectory.joints, trajectory.gripper, trajectory.thetas, trajectory.T_world_object
    )
    if T_world_plane is not None and soft is None:
        soft = cast_soft_shadow(twin, T_world_plane, threads)
    stands = (Ts == Ts[:1]).all((0, 2, 3))
    views = [_Still(twin, stands, Ts[0], layer, threads) for layer in layers.values()]
    shades: list[_SoftShades | _CrispShades] = []
    if soft is not None and T_world_plane is not None:
        shades.append(_SoftShades(twin, trajectory, soft, views, T_world_plane))
    if twin.directional_light is not None:
        shades.append(_CrispShades(twin, robot, Ts, soft is None, views, threads))
    moving = moving_layer(twin.select(~stands[twin.bodies]))
    batches: list[list[NDArray[np.uint8]]] = []
    for start in range(0, len(Ts), BATCH):
        chosen = slice(start, start + BATCH)
        motion = moving.motion(Ts[chosen])
        darkened = _darkened([item.factors(chosen) for item in shades], views, len(motion))
        sessions = [view.session for view in views]
        batches.append(draw_sessions(sessions, moving.gaussians, motion, darkened, threads))
    return {
        name: np.concatenate(images) for name, images in zip(layers, zip(*batches, strict=True), strict=True)
    }


class _Still:
    """What a camera sees of all that stands still in an episode.

    Attributes:
        session: Draws into it what moves.
        layer: Of the scene, without the robot and the object.
        scene_share: How much of each pixel's color (H, W) is of the scene, 0..1: shadows fall on that.
    """

    def __init__(
        self,
        twin: Twin,
        stands: NDArray[np.bool_],
        Ts_world_body: Array,
        layer: StaticLayer,
        threads: int | None,
    ) -> None:
        bodies = twin.select(stands[twin.bodies] & twin.moves)
        self.layer, self.session = layer, layer.session
        self.scene_share = np.ones(layer.depth.shape, np.float32)
        if not len(bodies.gaussians):
            return
        world = posed_by(bodies, Ts_world_body)
        scene = twin.gaussians.select(~twin.moves)
        self.session = RenderSession(concatenate([scene, world]), layer.camera, threads=threads)
        alone, both = (
            layer.session.draw(world, shade=np.full_like(self.scene_share, shade)).rgb.sum(-1)
            for shade in (0, 1)
        )
        self.scene_share = 1 - np.where(both > DARK, alone / np.maximum(both, DARK), 0)

    def surface(self, T_world_plane: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.float32]]:
        """Pixels (N,) that show a surface at all, as indices into H * W, points (N, 3) there, and its share (N,)."""
        depth = np.minimum(self.layer.depth, FAR).astype(np.float64)
        points, belongs = intersect_surface(T_world_plane, self.layer.camera, depth)
        share = (belongs * self.scene_share).astype(np.float32).ravel()
        pixels = np.flatnonzero(share > 0)
        return pixels, points.reshape(-1, 3)[pixels], share[pixels]


# For each camera the pixels (N,) that are darkened in a batch of T frames, and factors (T, N) on their colors.
Factors = list[tuple[NDArray[np.int64], NDArray[np.float32]]]


class _SoftShades:
    """The shadow that the object throws in the light from all around, from frame to frame."""

    def __init__(
        self,
        twin: Twin,
        trajectory: Trajectory,
        soft: SoftShadow,
        views: Sequence[_Still],
        T_world_plane: Array,
    ) -> None:
        assert twin.relit is not None
        lit = np.flatnonzero(twin.relit_bodies == twin.body(OBJECT))
        light = twin.relit.lights[twin.relit.light_of[lit[0]]]
        T_world_object = trajectory.T_world_object
        taken = 1 - soft.arriving(light, T_world_object).reshape(len(soft.thetas), -1)
        to_plane = invert(T_world_object @ soft.T_object_plane)
        self._states = soft.states(trajectory.thetas)
        self._places: Factors = []
        for view in views:
            pixels, points, share = view.surface(T_world_plane)
            dark = taken @ soft.grid.lookup(apply(to_plane, points)[:, :2]).T
            # sRGB is close to the power 1 / 2.2 of linear light.
            factors = 1 - share * (1 - np.maximum(1 - dark, 0) ** np.float32(1 / 2.2))
            hit = (factors < 1).any(0)
            self._places.append((pixels[hit], factors[:, hit]))

    def factors(self, frames: slice) -> Factors:
        states = self._states[frames]
        return [(pixels, states @ factors) for pixels, factors in self._places]


class _CrispShades:
    """The shadow that the robot, and perhaps the object's part, throws in a directional light."""

    def __init__(
        self,
        twin: Twin,
        robot: RobotModel,
        Ts_world_body: Array,
        with_part: bool,
        views: Sequence[_Still],
        threads: int | None,
    ) -> None:
        light, roles = twin.directional_light, shadow_roles(twin, robot)
        assert light is not None
        moving, stands = (roles == MOVES) & (with_part | (twin.bodies != twin.body(PART))), roles == STANDS
        self._bodies, self._parts, self._threads = twin.gaussians.select(moving), twin.bodies[moving], threads
        self._to_plane = invert(light.T_world_plane)
        self._direction = self._to_plane[:3, :3] @ light.direction
        self._Ts = self._to_plane @ Ts_world_body
        fixed = silhouette(
            twin.gaussians.select(stands),
            light.direction,
            RigidParts(indices=twin.bodies[stands], Ts_world_part=Ts_world_body[0]),
        )
        surfaces = [view.surface(light.T_world_plane) for view in views]
        self._grid = self._reached([points for _, points, _ in surfaces])
        shade = 1 - float(light.shade.mean())
        self._places = [
            (
                pixels,
                (shade * share * (1 - fixed.at(points))).astype(np.float32),
                self._grid.lookup(apply(self._to_plane, points)[:, :2]),
            )
            for pixels, points, share in surfaces
        ]

    def _reached(self, points_world: Sequence[Array]) -> PlaneGrid:
        """Cells where shadow may fall and is seen."""
        boxes = []
        for body in np.unique(self._parts):
            own = self._bodies.means[self._parts == body]
            corners = np.stack(
                np.meshgrid(*np.stack([own.min(0), own.max(0)], 1), indexing="ij"), -1
            ).reshape(-1, 3)
            cast = apply(self._Ts[:, None, body], corners)
            boxes.append(
                (cast[..., :2] - cast[..., 2:] * self._direction[:2] / self._direction[2]).reshape(-1, 2)
            )
        seen = [apply(self._to_plane, points)[:, :2] for points in points_world if len(points)]
        if not boxes or not seen:
            return PlaneGrid(low=np.zeros(2), cell=CRISP_CELL, columns=1, rows=1)
        cast, met = np.concatenate(boxes), np.concatenate(seen)
        low, high = np.maximum(cast.min(0), met.min(0)), np.minimum(cast.max(0), met.max(0))
        columns, rows = np.maximum(np.ceil((high - low) / CRISP_CELL), 0).astype(int).tolist()
        return PlaneGrid(low=low - CRISP_CELL, cell=CRISP_CELL, columns=columns + 2, rows=rows + 2)

    def factors(self, frames: slice) -> Factors:
        Ts = self._Ts[frames]
        toward = np.tile(self._direction, (len(Ts), 1))
        cast = cast_on_plane(self._bodies, self._parts, Ts, toward, self._grid, self._threads)
        flat = np.ascontiguousarray(cast.reshape(len(Ts), -1).T)
        return [(pixels, 1 - weight * (lookup @ flat).T) for pixels, weight, lookup in self._places]


def _darkened(
    shades: Sequence[Factors], views: Sequence[_Still], count: int
) -> list[NDArray[np.float32] | None]:
    """Factors (T, H, W) on each camera's still image; one light is taken only once."""
    images = []
    for index, view in enumerate(views):
        shape = view.layer.depth.shape
        image = np.ones((count, shape[0] * shape[1]), np.float32) if shades else None
        for factors in shades:
            pixels, values = factors[index]
            image[:, pixels] = np.minimum(image[:, pixels], values)
        images.append(None if image is None else image.reshape(count, *shape))
    return images
