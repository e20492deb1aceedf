"""Images of an episode from fixed cameras and from cameras that the robot carries, by the twin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.episodes.shading import (
    CrispShade,
    DarkMaps,
    Shade,
    ShadedPixels,
    SoftShade,
    States,
    color_factors,
    find_shaded_pixels,
    taken_light,
)
from aomgen.io.video import Codec
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.twin.plane_shadow import SoftShadow, cast_soft_shadow
from aomgen.twin.shadow import FAR, intersect_surface
from aomgen.twin.twin import (
    StaticLayer,
    Twin,
    moving_layer,
    posed_by,
    standing_bodies,
    static_layer,
    trajectory_body_poses,
)

# Frames that are drawn at once; bounds the memory of their colors and shades.
BATCH: Final = 32
# Colors darker than this have no share to speak of, 0..1.
DARK: Final = 1e-4
# Crisp shadow is followed this far around the path of a camera that moves, [m].
NEAR_PATH: Final = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageParams:
    """What is stored of an episode's images.

    Attributes:
        codec: Of the videos.
        depth: Also store depth, [mm].
        labels: Also store part labels.
        robot_cameras: Also draw what the robot's own cameras see, each of which costs as much as all fixed ones.
    """

    codec: Codec = "h264"
    depth: bool = False
    labels: bool = False
    robot_cameras: bool = False


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


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFrames:
    """What a camera shows in an episode.

    Attributes:
        images_srgb: Frames.
        depth_mm: Median depth, 0 for none; None unless asked for.
        labels: Part that is seen, see `conventions.PART_LABELS`; None unless asked for.
    """

    images_srgb: Annotated[NDArray[np.uint8], "T H W 3"]
    depth_mm: Annotated[NDArray[np.uint16], "T H W"] | None = None
    labels: Annotated[NDArray[np.uint8], "T H W"] | None = None


def render_episode(
    twin: Twin,
    robot: RobotModel,
    trajectory: Trajectory,
    layers: Mapping[str, StaticLayer],
    T_world_plane: Array | None = None,
    threads: int | None = None,
    *,
    soft: SoftShadow | None = None,
    paths: Mapping[str, CameraPath] | None = None,
    params: ImageParams = ImageParams(),
) -> dict[str, CameraFrames]:
    """Draw an episode from fixed and from moving cameras.

    Args:
        twin: With the object that stands in it.
        layers: From `static_layers`, of the same twin.
        T_world_plane: The surface that the object's shadow falls on; None for no shadow.
        threads: As in `splatting.rasterizer.render`.
        soft: From `cast_soft_shadow`, of the same twin and surface; None to find it here.
        paths: Cameras that move, by name.
        params: Which images.
    """
    states = states_of(twin, robot, trajectory)
    shades: list[Shade] = []
    if T_world_plane is not None:
        soft = cast_soft_shadow(twin, T_world_plane, threads) if soft is None else soft
        shades = soft_shades(twin, trajectory.T_world_object, soft, T_world_plane)
    batches = [states.part(slice(k, k + BATCH)) for k in range(0, len(states.thetas), BATCH)]
    drawn: dict[str, CameraFrames] = {}
    if layers:
        views = FixedViews(twin, robot, states.Ts_world_body[0], layers, shades, threads)
        outputs = _outputs(params)
        images = zip(*(views.draw(batch, outputs) for batch in batches), strict=True)
        frames = (_frames(items, views.labels, params) for items in images)
        drawn |= zip(layers, frames, strict=True)
    for name, path in (paths or {}).items():
        around = path.Ts_world_cam[:, None, :3, 3] + NEAR_PATH * np.stack([np.ones(3), -np.ones(3)])
        cast = _crisp_shade(twin, robot, states.Ts_world_body[0], around.reshape(-1, 3), shades, threads)
        drawn[name] = _draw_moving(twin, states, path, [*shades, *cast], params, threads)
    return drawn


def states_of(twin: Twin, robot: RobotModel, trajectory: Trajectory) -> States:
    """Where the twin's bodies are in a trajectory."""
    moved = (trajectory.joints, trajectory.gripper, trajectory.thetas)
    Ts = trajectory_body_poses(twin, robot, *moved, trajectory.T_world_object)
    return States(Ts, trajectory.thetas)


def soft_shades(
    twin: Twin, T_world_object: Array, soft: SoftShadow | None, T_world_plane: Array
) -> list[Shade]:
    """The shadow of the object where it stands, if it is lit."""
    return [] if soft is None else [SoftShade(twin, T_world_object, soft, T_world_plane)]


def _crisp_shade(
    twin: Twin,
    robot: RobotModel,
    Ts_world_body: Array,
    seen_world: Array,
    shades: Sequence[Shade],
    threads: int | None,
) -> list[Shade]:
    """The shadow in a directional light, where there is one; of all of the object, where it throws a new one."""
    if twin.directional_light is None:
        return []
    return [CrispShade(twin, robot, Ts_world_body, seen_world, with_static=bool(shades), threads=threads)]


class FixedViews:
    """What fixed cameras show of an object that stands at a pose: prepared once, then drawn for any states.

    The pictures of a state do not depend on what else is drawn.

    Args:
        twin, robot, layers, threads: As of `render_episode`.
        Ts_world_body: Poses (B, 4, 4) of the twin's bodies in any state.
        shades: The object's soft shadow, if any.

    Attributes:
        labels: Of all Gaussians, in the engine's order.
    """

    def __init__(
        self,
        twin: Twin,
        robot: RobotModel,
        Ts_world_body: Array,
        layers: Mapping[str, StaticLayer],
        shades: Sequence[Shade],
        threads: int | None,
    ) -> None:
        stands = standing_bodies(twin, robot)
        self._threads = threads
        self._moving = moving_layer(twin.select(~stands[twin.bodies]))
        bodies = twin.select(stands[twin.bodies] & twin.moves)
        world = posed_by(bodies, Ts_world_body)
        still = concatenate([twin.gaussians.select(~twin.moves), world])
        self._views = [_StillView(layer, world, still, threads) for layer in layers.values()]
        self.labels = np.concatenate([twin.labels[~twin.moves], bodies.labels, self._moving.labels])
        light = twin.directional_light
        seen = [] if light is None else [view.points_on(light.T_world_plane) for view in self._views]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        self._shades = [*shades, *_crisp_shade(twin, robot, Ts_world_body, points, shades, threads)]
        self._pixels = [
            [
                find_shaded_pixels(shade, view.layer.camera, view.layer.depth, view.scene_share)
                for shade in self._shades
            ]
            for view in self._views
        ]

    def draw(self, states: States, outputs: Sequence[str]) -> list[dict[str, NDArray]]:
        """Images (T, H, W, ...) of each camera by output, see `draw_outputs`."""
        dark = [shade.dark(states) for shade in self._shades]
        shaded = zip(self._views, self._pixels, strict=True)
        darkened = [view.darkened(pixels, dark) for view, pixels in shaded] if dark else None
        motion = self._moving.motion(states.Ts_world_body)
        sessions = [view.session for view in self._views]
        return draw_outputs(sessions, self._moving.gaussians, motion, outputs, darkened, self._threads)


class _StillView:
    """What a fixed camera sees of all that stands still in an episode.

    Attributes:
        session: Draws into it what moves.
        layer: Of the scene, without the robot and the object.
        scene_share: How much of each pixel's color (H, W) is of the scene, 0..1: shadows fall on that.

    Args:
        layer: See above.
        bodies: What stands there of robot and object, world frame.
        still: Scene and bodies.
        threads: As of `RenderSession`.
    """

    def __init__(self, layer: StaticLayer, bodies: Gaussians, still: Gaussians, threads: int | None) -> None:
        self.layer, self.session = layer, layer.session
        self.scene_share = np.ones(layer.depth.shape, np.float32)
        if not len(bodies):
            return
        self.session = RenderSession(still, layer.camera, threads=threads)
        alone = layer.session.draw(bodies, shade=np.zeros_like(self.scene_share)).rgb.sum(-1)
        both = self.session.draw(bodies.select(np.zeros(0, np.int64))).rgb.sum(-1)
        self.scene_share = 1 - np.where(both > DARK, alone / np.maximum(both, DARK), 0)

    def darkened(self, shaded: Sequence[ShadedPixels], dark: Sequence[DarkMaps]) -> NDArray[np.float32]:
        """Factors (T, H, W) on the colors of the scene in shadows; at least one."""
        shape = self.layer.depth.shape
        taken = np.zeros((len(dark[0].shares), shape[0] * shape[1]), np.float32)
        for item, maps in zip(shaded, dark, strict=True):
            taken[:, item.pixels] += item.taken(maps)
        return color_factors(taken).reshape(-1, *shape)

    def points_on(self, T_world_plane: Array) -> Array:
        """What is seen of a surface (N, 3)."""
        far = np.minimum(self.layer.depth, FAR).astype(np.float64)
        points, belongs = intersect_surface(T_world_plane, self.layer.camera, far)
        return points[belongs > 0]


def _outputs(params: ImageParams, *, shaded: bool = False) -> tuple[str, ...]:
    more = params.depth or params.labels or shaded
    return ("rgb8", "alpha", "median_depth", "max_id") if more else ("rgb8",)


def _frames(
    batches: Sequence[Mapping[str, NDArray]], labels: NDArray[np.uint8], params: ImageParams
) -> CameraFrames:
    """All batches of a camera as one; `labels` (N,) of the Gaussians in the engine's order."""
    depth, parts = None, None
    if params.depth:
        depth = np.concatenate([np.rint(np.clip(1000 * item["median_depth"], 0, 65535)) for item in batches])
    if params.labels:
        # Where less than half of the light comes from Gaussians, the background is seen.
        parts = np.concatenate(
            [np.where(item["median_depth"] > 0, labels[item["max_id"]], BACKGROUND) for item in batches]
        )
    return CameraFrames(
        images_srgb=np.concatenate([item["rgb8"] for item in batches]),
        depth_mm=None if depth is None else depth.astype(np.uint16),
        labels=None if parts is None else parts.astype(np.uint8),
    )


def _draw_moving(
    twin: Twin,
    states: States,
    path: CameraPath,
    shades: Sequence[Shade],
    params: ImageParams,
    threads: int | None,
) -> CameraFrames:
    """Frames of a camera for which nothing stands still: everything moves before it."""
    everything = moving_layer(twin)
    scene = everything.bodies == 0
    session = RenderSession(
        twin.gaussians.select(np.zeros(0, np.int64)), path.camera.moved(np.eye(4)), threads=threads
    )
    batches = []
    for start in range(0, len(states.thetas), BATCH):
        chosen = slice(start, start + BATCH)
        motion = everything.motion(states.Ts_world_body[chosen])
        before = Motion(
            parts=motion.parts,
            Ts_world_part=np.linalg.inv(path.Ts_world_cam[chosen])[:, None] @ motion.Ts_world_part,
            colors=motion.colors,
        )
        outputs = _outputs(params, shaded=bool(shades))
        (images,) = draw_outputs([session], everything.gaussians, before, outputs, threads=threads)
        dark = [shade.dark(states.part(chosen)) for shade in shades]
        for t in range(len(motion) if shades else 0):
            depth, camera = images["median_depth"][t], path.at(start + t)
            taken = sum(
                taken_light(shade, maps, t, camera, depth) for shade, maps in zip(shades, dark, strict=True)
            )
            factors = np.where(scene[images["max_id"][t]], color_factors(np.asarray(taken)), 1)
            images["rgb8"][t] = np.rint(images["rgb8"][t] * factors[..., None])
        batches.append(images)
    return _frames(batches, everything.labels, params)


def static_layers(
    twin: Twin, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """What each camera sees of the scene that never moves; the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}
