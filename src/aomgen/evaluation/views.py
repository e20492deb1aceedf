"""Images of a trial, rendered from Gaussians, or by MuJoCo in front of an image of the scene as in the paper."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera
from aomgen.core.demonstration import Trajectory
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.values import Array
from aomgen.episodes.camera_views import FixedViews, MovingView
from aomgen.episodes.factory import EpisodeFactory, OpenAsset
from aomgen.episodes.render import states_of
from aomgen.lighting.episode_shadows import cast_shadows
from aomgen.robots.silhouette import FAR_M
from aomgen.simulation.scene import build_scene
from aomgen.simulation.scene_renderer import SceneRenderer
from aomgen.twin.twin import StaticLayer, static_layer

Visuals = Literal["splat", "simulator"]
VISUALS: Final[tuple[Visuals, ...]] = get_args(Visuals)
# Ambient light and headlight of the simulator; their sum renders a white surface about white.
AMBIENT, DIFFUSE = 0.5, 0.5
Images = dict[str, NDArray[np.uint8]]


class SplatViews:
    """Renderer of a trial from Gaussians, like an episode; `carried` names additional cameras of the robot.

    Each rendered state is a trajectory of one sample.
    """

    def __init__(
        self,
        factory: EpisodeFactory,
        opened: OpenAsset,
        fitted: FittedAsset,
        variation: Variation,
        carried: tuple[str, ...] = (),
    ) -> None:
        self._robot, self._T = factory.results.robot, variation.place_at(fitted)
        self._cameras = factory.place.cameras
        self._twin, layers, soft = opened.show_variation(variation, self._cameras)
        demo = factory.results.demonstration
        first = replace(demo.at(demo.times_s[:1]), gripper=np.zeros(1), thetas=np.full(1, fitted.start_theta))
        Ts = self._states(first).Ts_world_body[0]
        eyes = np.stack([camera.center for camera in self._cameras.values()])
        T_world_plane = factory.results.episode_scene.T_world_plane
        twin, shadows = cast_shadows(self._twin, self._robot, Ts, eyes, soft, T_world_plane, threads=1)
        self._views = FixedViews(twin, self._robot, Ts, layers, shadows, threads=1)
        optics = {name: self._robot.cameras[name][1] for name in carried}
        self._carried = {name: MovingView(twin, view, shadows, threads=1) for name, view in optics.items()}

    def draw(self, reached: Trajectory) -> Images:
        """Render an image (H, W, 3) of every camera."""
        states = self._states(reached)
        drawn = dict(zip(self._cameras, self._views.draw(states, ("rgb8",)), strict=True))
        paths = self._robot.camera_paths(reached.joints, reached.gripper) if self._carried else {}
        drawn |= {name: view.draw(states, paths[name], ("rgb8",)) for name, view in self._carried.items()}
        return {name: item["rgb8"][0] for name, item in drawn.items()}

    def _states(self, reached: Trajectory) -> Any:
        return states_of(self._twin, self._robot, reached.with_object(self._T))


class SimulatorViews:
    """Renderer of robot, table and object with MuJoCo, in front of a wall with the image of the scene's Gaussians.

    Each camera has a separate wall, at the distance for which its image was rendered. Source: AOMGen, sec. 5.3.
    """

    def __init__(
        self,
        factory: EpisodeFactory,
        opened: OpenAsset,
        fitted: FittedAsset,
        variation: Variation,
        carried: tuple[str, ...] = (),
    ) -> None:
        results, place = factory.results, factory.place
        T, self._cameras, self._robot = variation.place_at(fitted), place.cameras, results.robot
        self._carried = {name: self._robot.cameras[name][1] for name in carried}
        self._scene = build_scene(results.robot, fitted.asset, T, place.support, visual=True)
        self._scene.model.geom_group[self._scene.roles.table] = VISUAL_GROUP
        light = self._scene.model.vis.headlight
        light.ambient[:], light.diffuse[:] = AMBIENT, DIFFUSE
        sizes = [
            (camera.width, camera.height) for camera in (*self._cameras.values(), *self._carried.values())
        ]
        self._renderer = SceneRenderer(self._scene, tuple(np.max(sizes, 0).tolist()))
        self._twin, layers, _ = opened.show_variation(variation, self._cameras)
        self._walls = {name: self._wall(layer) for name, layer in layers.items()}

    def draw(self, reached: Trajectory) -> Images:
        """Render an image (H, W, 3) of every camera."""
        qpos = self._scene.qpos(reached.joints, reached.gripper, reached.thetas)[0]
        cameras, walls = dict(self._cameras), dict(self._walls)
        if self._carried:
            paths = self._robot.camera_paths(reached.joints, reached.gripper)
            cameras |= {name: paths[name].at(0) for name in self._carried}
            walls |= {name: self._wall(static_layer(self._twin, cameras[name], 1)) for name in self._carried}
        return {name: self._before(walls[name], camera, qpos) for name, camera in cameras.items()}

    def _wall(self, layer: StaticLayer) -> NDArray[np.uint8]:
        image_srgb, _ = layer.session.picture(self._twin.gaussians.select(np.zeros(0, np.int64)))
        return image_srgb

    def _before(self, wall: NDArray[np.uint8], camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        shown, depth = self._renderer.draw(camera, qpos), self._renderer.depths(camera, qpos)
        return np.where((depth < FAR_M)[..., None], shown, wall)


TrialViews = SplatViews | SimulatorViews
KINDS: Final[Mapping[str, Any]] = {"splat": SplatViews, "simulator": SimulatorViews}
