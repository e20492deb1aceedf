"""Images of an episode from fixed cameras and from cameras that the robot carries, by the twin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.gaussians import concatenate
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.episodes.shading import CrispShade, Shade, SoftShade, find_shaded_pixels, shaded_factors
from aomgen.io.video import Codec
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.twin.plane_shadow import SoftShadow, cast_soft_shadow
from aomgen.twin.twin import (
    StaticLayer,
    Twin,
    moving_layer,
    posed_by,
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
    Ts = trajectory_body_poses(
        twin, robot, trajectory.joints, trajectory.gripper, trajectory.thetas, trajectory.T_world_object
    )
    shades: list[Shade] = []
    if T_world_plane is not None:
        soft = cast_soft_shadow(twin, T_world_plane, threads) if soft is None else soft
        if soft is not None:
            shades.append(SoftShade(twin, trajectory.thetas, trajectory.T_world_object, soft, T_world_plane))
    stands = (Ts == Ts[:1]).all((0, 2, 3))
    views = [_StillView(twin, stands, Ts[0], layer, threads) for layer in layers.values()]
    drawn: dict[str, CameraFrames] = {}
    if views:
        alone = None if twin.directional_light is None else not shades
        seen = [view.points() for view in views]
        cast = [] if alone is None else [CrispShade(twin, robot, Ts, seen, with_part=alone, threads=threads)]
        frames = _draw_fixed(twin, Ts, stands, views, [*shades, *cast], params, threads)
        drawn |= zip(layers, frames, strict=True)
    for name, path in (paths or {}).items():
        around = path.Ts_world_cam[:, None, :3, 3] + NEAR_PATH * np.stack([np.ones(3), -np.ones(3)])
        cast = (
            []
            if twin.directional_light is None
            else [CrispShade(twin, robot, Ts, [around], with_part=not shades, threads=threads)]
        )
        drawn[name] = _draw_moving(twin, Ts, path, [*shades, *cast], params, threads)
    return drawn


class _StillView:
    """What a fixed camera sees of all that stands still in an episode.

    Attributes:
        session: Draws into it what moves.
        layer: Of the scene, without the robot and the object.
        labels: Of the session's Gaussians.
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
        self.labels = np.append(twin.labels[~twin.moves], bodies.labels)
        if not len(bodies.gaussians):
            return
        world = posed_by(bodies, Ts_world_body)
        scene = twin.gaussians.select(~twin.moves)
        self.session = RenderSession(concatenate([scene, world]), layer.camera, threads=threads)
        alone = layer.session.draw(world, shade=np.zeros_like(self.scene_share)).rgb.sum(-1)
        both = self.session.draw(world.select(np.zeros(0, np.int64))).rgb.sum(-1)
        self.scene_share = 1 - np.where(both > DARK, alone / np.maximum(both, DARK), 0)

    def points(self) -> Array:
        """What is seen of the scene (H, W, 3)."""
        camera, depth = self.layer.camera, self.layer.depth
        return (camera.center + camera.directions() * depth[..., None])[np.isfinite(depth)]


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


def _draw_fixed(
    twin: Twin,
    Ts_world_body: Array,
    stands: NDArray[np.bool_],
    views: Sequence[_StillView],
    shades: Sequence[Shade],
    params: ImageParams,
    threads: int | None,
) -> list[CameraFrames]:
    moving = moving_layer(twin.select(~stands[twin.bodies]))
    places = [
        [find_shaded_pixels(shade, view.layer.camera, view.layer.depth, view.scene_share) for shade in shades]
        for view in views
    ]
    batches = []
    for start in range(0, len(Ts_world_body), BATCH):
        chosen = slice(start, start + BATCH)
        motion = moving.motion(Ts_world_body[chosen])
        dark = [shade.dark(chosen) for shade in shades]
        darkened: list[NDArray[np.float32] | None] = [None] * len(views)
        for index, view in enumerate(views if shades else ()):
            image = np.ones((len(motion), view.layer.depth.size), np.float32)
            for place, maps in zip(places[index], dark, strict=True):
                # One light is taken only once.
                image[:, place.pixels] = np.minimum(image[:, place.pixels], place.factors(maps))
            darkened[index] = image.reshape(len(motion), *view.layer.depth.shape)
        sessions = [view.session for view in views]
        batches.append(draw_outputs(sessions, moving.gaussians, motion, _outputs(params), darkened, threads))
    return [
        _frames(items, np.append(view.labels, moving.labels), params)
        for view, items in zip(views, zip(*batches, strict=True), strict=True)
    ]


def _draw_moving(
    twin: Twin,
    Ts_world_body: Array,
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
    for start in range(0, len(Ts_world_body), BATCH):
        chosen = slice(start, start + BATCH)
        motion = everything.motion(Ts_world_body[chosen])
        before = Motion(
            parts=motion.parts,
            Ts_world_part=np.linalg.inv(path.Ts_world_cam[chosen])[:, None] @ motion.Ts_world_part,
            colors=motion.colors,
        )
        outputs = _outputs(params, shaded=bool(shades))
        (images,) = draw_outputs([session], everything.gaussians, before, outputs, threads=threads)
        dark = [shade.dark(chosen) for shade in shades]
        for t in range(len(motion) if shades else 0):
            depth, camera = images["median_depth"][t], path.at(start + t)
            found = [
                shaded_factors(shade, maps[t], camera, depth)
                for shade, maps in zip(shades, dark, strict=True)
            ]
            factors = np.where(scene[images["max_id"][t]], np.minimum.reduce(found), 1)
            images["rgb8"][t] = np.rint(images["rgb8"][t] * factors[..., None])
        batches.append(images)
    return _frames(batches, everything.labels, params)


def static_layers(
    twin: Twin, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """What each camera sees of the scene that never moves; the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}
