"""Scenes of the twin page: Gaussians with their shadows, rendered from any camera."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import PART_LABELS
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.gaussians import Gaussians
from aomgen.core.plan import Variation
from aomgen.core.values import Array
from aomgen.episodes.camera_views import MovingView
from aomgen.io.artifact import load_artifact
from aomgen.lighting.episode_shadows import States, TableShadow, cast_shadows
from aomgen.lighting.object_shadow import tabulate_object_shadow
from aomgen.results import Results
from aomgen.robots.robot import RobotModel
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import TwinModel, TwinState, body_poses, pose_bodies
from aomgen.twin.variation import change_appearance, scale_object

# Number of cached views: two sizes during dragging, before and after a part is hidden.
KEPT_VIEWS: Final = 4


class View(NamedTuple):
    """Image (H, W, 3) uint8 sRGB, alpha (H, W) 0..1, and depth (H, W) [m], 0 in empty pixels."""

    image_srgb: NDArray[np.uint8]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]


class PosableScene:
    """A twin with the shadows of its moving bodies.

    Attributes:
        twin, robot: The twin, and its robot.
        rest: The initial state.
    """

    def __init__(
        self, twin: TwinModel, robot: RobotModel, shadows: Sequence[TableShadow], rest: TwinState
    ) -> None:
        self.twin, self.robot, self.rest, self._shadows = twin, robot, rest, shadows
        self._views = lru_cache(KEPT_VIEWS)(self._open_view)

    def draw(self, state: TwinState, camera: Camera, parts: Collection[str]) -> View:
        """Render parts of the scene, given as keys of `conventions.PART_LABELS`, in a state."""
        optics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        Ts = body_poses(self.twin, self.robot, state)[None]
        path = CameraPath(camera=camera, Ts_world_cam=camera.T_world_cam[None])
        view = self._views(frozenset(parts), optics)
        drawn = view.draw(
            States(Ts, np.array([state.theta])), path, ("rgb8", "alpha", "median_depth", "max_id")
        )
        return View(*(drawn[name][0] for name in ("rgb8", "alpha", "median_depth")))

    def find_center(self) -> Array:
        """Compute the mean point (3,) of the object at rest, world frame."""
        mine = replace(self.twin, relit=None).select(_select(self.twin.labels, ("static", "moving")))
        return (
            pose_bodies(mine, body_poses(self.twin, self.robot, self.rest)).means.mean(0).astype(np.float64)
        )

    def _open_view(self, parts: frozenset[str], optics: tuple[float, ...]) -> MovingView:
        twin = self.twin.select(_select(self.twin.labels, parts))
        names = ("fx", "fy", "cx", "cy", "width", "height")
        camera = Camera(**dict(zip(names, optics, strict=True)), T_world_cam=np.eye(4))  # pyright: ignore[reportArgumentType]
        shadows = self._shadows if "background" in parts else ()
        return MovingView(twin, camera, shadows, None)


class ScannedScene:
    """Gaussians of a scan without a twin, with part labels (N,) as soon as they are known."""

    def __init__(self, gaussians: Gaussians, labels: NDArray[np.uint8] | None) -> None:
        def choose(parts: frozenset[str]) -> Gaussians:
            return gaussians if labels is None else gaussians.select(_select(labels, parts))

        self._choose: Callable[[frozenset[str]], Gaussians] = cache(choose)

    def draw(self, state: TwinState, camera: Camera, parts: Collection[str]) -> View:
        """Render parts of the scan, given as keys of `conventions.PART_LABELS`, in its recorded state."""
        drawn = render(self._choose(frozenset(parts)), camera, with_ids=True)
        image = np.clip(np.rint(drawn.rgb * 255), 0, 255).astype(np.uint8)
        return View(image, drawn.alpha, np.asarray(drawn.median_depth))


ViewedScene = PosableScene | ScannedScene


def _select(labels: NDArray[np.uint8], parts: Collection[str]) -> NDArray[np.bool_]:
    return np.isin(labels, [PART_LABELS[name] for name in parts])


def open_recorded_scene(twin: TwinModel, robot: RobotModel) -> PosableScene:
    """Open the twin of the recording, with the shadow of its directional light."""
    Ts = body_poses(twin, robot, twin.scan_state)
    twin, shadows = cast_shadows(twin, robot, Ts, np.zeros((0, 3)), None, None, None)
    return PosableScene(twin, robot, shadows, twin.scan_state)


def open_episode_scene(
    results: Results, robot: RobotModel, asset: int, variation: Variation, first: TwinState, eyes_world: Array
) -> PosableScene:
    """Open the scene of an episode as rendered in its videos.

    Args:
        results: Results of a run whose stage "replacement" has finished.
        robot: Robot of the run.
        asset: Number of the fitted asset.
        variation: Variation of the episode.
        first: First state of the episode.
        eyes_world: Centers (K, 3) of the episode's cameras, from which the object's shadow on walls is computed.
    """
    recorded = load_artifact(results.asset_folder(asset), "twin", TwinModel)
    T_world_plane = results.episode_scene.T_world_plane
    soft = tabulate_object_shadow(recorded, T_world_plane)
    twin = change_appearance(scale_object(recorded, variation.scale), variation.light, variation.material)
    soft = soft and soft.scale_by(variation.scale, twin.joint.type == "prismatic")
    Ts = body_poses(twin, robot, first)
    twin, shadows = cast_shadows(twin, robot, Ts, eyes_world, soft, T_world_plane, None)
    return PosableScene(twin, robot, shadows, first)
