"""Images of an episode from fixed cameras and from cameras that the robot carries, by the twin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.values import Array
from aomgen.episodes.camera_views import FixedViews, MovingView
from aomgen.io.video import Codec
from aomgen.lighting.episode_shadows import States, cast_shadows
from aomgen.lighting.object_shadow import ObjectShadow, tabulate_object_shadow
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import (
    StaticLayer,
    TwinModel,
    static_layer,
    trajectory_body_poses,
)

# Number of frames that are rendered at once; bounds the memory of their colors and shadows.
BATCH: Final = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageParams:
    """Stored images of an episode.

    Attributes:
        codec: Codec of the videos.
        depth: Also store depth, [mm].
        labels: Also store part labels.
        robot_cameras: Also render the robot's own cameras, each of which costs as much as all fixed ones.
    """

    codec: Codec = "h264"
    depth: bool = False
    labels: bool = False
    robot_cameras: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFrames:
    """Images of a camera in an episode.

    Attributes:
        images_srgb: Frames.
        depth_mm: Median depth, 0 for none; None unless requested.
        labels: Visible part, see `conventions.PART_LABELS`; None unless requested.
    """

    images_srgb: Annotated[NDArray[np.uint8], "T H W 3"]
    depth_mm: Annotated[NDArray[np.uint16], "T H W"] | None = None
    labels: Annotated[NDArray[np.uint8], "T H W"] | None = None


def render_episode(
    twin: TwinModel,
    robot: RobotModel,
    trajectory: SceneTrajectory,
    layers: Mapping[str, StaticLayer],
    T_world_plane: Array | None = None,
    threads: int | None = None,
    *,
    soft: ObjectShadow | None = None,
    paths: Mapping[str, CameraPath] | None = None,
    params: ImageParams = ImageParams(),
) -> dict[str, CameraFrames]:
    """Render an episode from fixed and from moving cameras.

    Args:
        twin: Twin with the object of the episode.
        layers: Result of `static_layers` for the same twin.
        T_world_plane: Pose of the surface that the object's shadow falls on; None for no shadow.
        threads: See `splatting.rasterizer.render`.
        soft: Result of `tabulate_object_shadow` for the same twin and surface; None to compute it here.
        paths: Moving cameras, by name.
        params: Images to render.
    """
    states = states_of(twin, robot, trajectory)
    Ts = states.Ts_world_body[0]
    if T_world_plane is not None and soft is None:
        soft = tabulate_object_shadow(twin, T_world_plane, threads)
    moving = [path.Ts_world_cam[:, :3, 3] for path in (paths or {}).values()]
    eyes = np.concatenate([np.reshape([layer.camera.center for layer in layers.values()], (-1, 3)), *moving])
    twin, shadows = cast_shadows(twin, robot, Ts, eyes, soft, T_world_plane, threads)
    batches = [states.part(slice(k, k + BATCH)) for k in range(0, len(states.thetas), BATCH)]
    drawn: dict[str, CameraFrames] = {}
    if layers:
        views = FixedViews(twin, robot, Ts, layers, shadows, threads)
        outputs = _outputs(params)
        images = zip(*(views.draw(batch, outputs) for batch in batches), strict=True)
        frames = (_frames(items, views.labels, params) for items in images)
        drawn |= zip(layers, frames, strict=True)
    for name, path in (paths or {}).items():
        view = MovingView(twin, path.camera, shadows, threads)
        parts = zip(batches, path.batches(BATCH), strict=True)
        images = [view.draw(batch, part, _outputs(params)) for batch, part in parts]
        drawn[name] = _frames(images, view.labels, params)
    return drawn


def states_of(twin: TwinModel, robot: RobotModel, trajectory: SceneTrajectory) -> States:
    """Compute poses of the twin's bodies in a trajectory."""
    moved = (trajectory.joints, trajectory.gripper, trajectory.thetas)
    Ts = trajectory_body_poses(twin, robot, *moved, trajectory.T_world_object)
    return States(Ts, trajectory.thetas)


def _outputs(params: ImageParams) -> tuple[str, ...]:
    more = params.depth or params.labels
    return ("rgb8", "alpha", "median_depth", "max_id") if more else ("rgb8",)


def _frames(
    batches: Sequence[Mapping[str, NDArray]], labels: NDArray[np.uint8], params: ImageParams
) -> CameraFrames:
    """Join all batches of a camera; `labels` (N,) of the Gaussians are in the engine's order."""
    depth, parts = None, None
    if params.depth:
        depth = np.concatenate([np.rint(np.clip(1000 * item["median_depth"], 0, 65535)) for item in batches])
    if params.labels:
        # Pixels with less than half of accumulated alpha show the background.
        parts = np.concatenate(
            [np.where(item["median_depth"] > 0, labels[item["max_id"]], BACKGROUND) for item in batches]
        )
    return CameraFrames(
        images_srgb=np.concatenate([item["rgb8"] for item in batches]),
        depth_mm=None if depth is None else depth.astype(np.uint16),
        labels=None if parts is None else parts.astype(np.uint8),
    )


def static_layers(
    twin: TwinModel, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """Render each camera's view of the static scene; it is the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}
