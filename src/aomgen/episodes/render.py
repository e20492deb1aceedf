"""Images of an episode from fixed cameras and from cameras that the robot carries, by the twin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.keypoints import judge_visible
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
        visible: Which keypoints the images show; None unless requested.
    """

    images_srgb: Annotated[NDArray[np.uint8], "T H W 3"]
    depth_mm: Annotated[NDArray[np.uint16], "T H W"] | None = None
    labels: Annotated[NDArray[np.uint8], "T H W"] | None = None
    visible: Annotated[NDArray[np.bool_], "T 5"] | None = None


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
    points_world: Array | None = None,
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
        points_world: Keypoints (T, 5, 3) whose visibility is judged; None for none.
        params: Images to render.
    """
    states = states_of(twin, robot, trajectory)
    Ts = states.Ts_world_body[0]
    if T_world_plane is not None and soft is None:
        soft = tabulate_object_shadow(twin, T_world_plane, threads)
    moving = dict(paths or {})
    carried = [path.Ts_world_cam[:, :3, 3] for path in moving.values()]
    eyes = np.concatenate([np.reshape([layer.camera.center for layer in layers.values()], (-1, 3)), *carried])
    twin, shadows = cast_shadows(twin, robot, Ts, eyes, soft, T_world_plane, threads)
    outputs = _outputs(params, points_world)
    still = {
        name: CameraPath(camera=layer.camera, Ts_world_cam=np.tile(layer.camera.T_world_cam, (BATCH, 1, 1)))
        for name, layer in layers.items()
    }
    parts: dict[str, list[CameraFrames]] = {name: [] for name in (*still, *moving)}
    fixed = FixedViews(twin, robot, Ts, layers, shadows, threads) if layers else None
    views = {name: MovingView(twin, path.camera, shadows, threads) for name, path in moving.items()}
    for start in range(0, len(states.thetas), BATCH):
        batch = slice(start, start + BATCH)
        chosen = states.part(batch)
        points = None if points_world is None else points_world[batch]
        if fixed is not None:
            for (name, path), images in zip(still.items(), fixed.draw(chosen, outputs), strict=True):
                parts[name].append(_make_frames(images, fixed.labels, path, points, params))
        for name, view in views.items():
            path = moving[name].part(batch)
            images = view.draw(chosen, path, outputs)
            parts[name].append(_make_frames(images, view.labels, path, points, params))
    return {name: _join_frames(found) for name, found in parts.items()}


def states_of(twin: TwinModel, robot: RobotModel, trajectory: SceneTrajectory) -> States:
    """Compute poses of the twin's bodies in a trajectory."""
    moved = (trajectory.joints, trajectory.gripper, trajectory.thetas)
    Ts = trajectory_body_poses(twin, robot, *moved, trajectory.T_world_object)
    return States(Ts, trajectory.thetas)


def _outputs(params: ImageParams, points_world: Array | None) -> tuple[str, ...]:
    more = params.depth or params.labels or points_world is not None
    return ("rgb8", "alpha", "median_depth", "max_id") if more else ("rgb8",)


def _make_frames(
    images: Mapping[str, NDArray],
    labels: NDArray[np.uint8],
    path: CameraPath,
    points_world: Array | None,
    params: ImageParams,
) -> CameraFrames:
    """Convert a camera's outputs by name; `labels` (N,) of the Gaussians are in the engine's order."""
    depth, parts, visible = None, None, None
    if "max_id" in images:
        # Pixels with less than half of accumulated alpha show the background.
        parts = np.where(images["median_depth"] > 0, labels[images["max_id"]], BACKGROUND).astype(np.uint8)
    if params.depth:
        depth = np.rint(np.clip(1000 * images["median_depth"], 0, 65535)).astype(np.uint16)
    if points_world is not None and parts is not None:
        shown = zip(points_world, images["median_depth"], parts, strict=True)
        visible = np.stack([judge_visible(path.at(t), *frame) for t, frame in enumerate(shown)])
    return CameraFrames(
        images_srgb=images["rgb8"],
        depth_mm=depth,
        labels=parts if params.labels else None,
        visible=visible,
    )


def _join_frames(parts: Sequence[CameraFrames]) -> CameraFrames:
    """Join all batches of a camera."""
    joined: dict[str, Any] = {}
    for item in fields(CameraFrames):
        values = [getattr(part, item.name) for part in parts]
        joined[item.name] = None if values[0] is None else np.concatenate(values)
    return CameraFrames(**joined)


def static_layers(
    twin: TwinModel, cameras: Mapping[str, Camera], threads: int | None = None
) -> dict[str, StaticLayer]:
    """Render each camera's view of the static scene; it is the same for all episodes of a scene."""
    return {name: static_layer(twin, camera, threads) for name, camera in cameras.items()}
