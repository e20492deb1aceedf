"""What cameras see of a trial: the twin's Gaussians, or MuJoCo's meshes before a picture of the scene, as in the paper."""

from collections.abc import Mapping
from typing import Any, Final, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.mjcf import VISUAL_GROUP
from aomgen.core.camera import Camera
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.values import Array
from aomgen.episodes.factory import EpisodeFactory, OpenAsset
from aomgen.episodes.fixed_views import FixedViews, soft_shades
from aomgen.episodes.render import Trajectory, states_of
from aomgen.robots.model_renderer import FAR_M
from aomgen.simulation.replay import Reached
from aomgen.simulation.scene import build_scene
from aomgen.synthetic.scene_recording import SceneRenderer

Visuals = Literal["splat", "simulator"]
VISUALS: Final[tuple[Visuals, ...]] = get_args(Visuals)
# The simulator's light from everywhere and from the camera: together a white surface is about white.
AMBIENT, DIFFUSE = 0.5, 0.5
Images = dict[str, NDArray[np.uint8]]


class TrialViews(Protocol):
    """Draws states of one trial."""

    def draw(self, reached: Reached) -> Images:
        """Image (H, W, 3) of every camera."""
        ...


class SplatViews:
    """Draws a trial as its episode would be drawn."""

    def __init__(
        self, factory: EpisodeFactory, opened: OpenAsset, fitted: FittedAsset, variation: Variation
    ) -> None:
        self._robot, self._T = factory.results.robot, variation.placed(fitted)
        self._cameras = factory.place.cameras
        self._twin, layers, soft = opened.seen(variation, self._cameras)
        shades = soft_shades(
            self._twin, self._robot, self._T, soft, factory.results.episode_scene.T_world_plane
        )
        demo = factory.results.demonstration
        first = Reached(demo.joints[0], 0.0, fitted.start_theta, demo.Ts_world_ee[0])
        Ts = self._states(first).Ts_world_body[0]
        self._views = FixedViews(self._twin, self._robot, Ts, layers, shades, threads=1)

    def draw(self, reached: Reached) -> Images:
        """Image (H, W, 3) of every camera."""
        drawn = self._views.draw(self._states(reached), ("rgb8",))
        return {name: item["rgb8"][0] for name, item in zip(self._cameras, drawn, strict=True)}

    def _states(self, reached: Reached) -> Any:
        return states_of(
            self._twin,
            self._robot,
            Trajectory(
                joints=reached.joints[None],
                gripper=np.array([reached.gripper]),
                thetas=np.array([reached.theta]),
                T_world_object=self._T,
            ),
        )


class SimulatorViews:
    """Draws robot, table and object with MuJoCo's renderer; behind them a wall shows the scene's splat picture.

    The wall is as far away as its picture was taken for: each camera sees its own. Source: AOMGen, sec. 5.3.
    """

    def __init__(
        self, factory: EpisodeFactory, opened: OpenAsset, fitted: FittedAsset, variation: Variation
    ) -> None:
        results, place = factory.results, factory.place
        T, self._cameras = variation.placed(fitted), place.cameras
        self._scene = build_scene(results.robot, fitted.asset, T, place.support, visual=True)
        self._scene.model.geom_group[self._scene.roles.table] = VISUAL_GROUP
        light = self._scene.model.vis.headlight
        light.ambient[:], light.diffuse[:] = AMBIENT, DIFFUSE
        sizes = [(camera.width, camera.height) for camera in self._cameras.values()]
        self._renderer = SceneRenderer(self._scene, tuple(np.max(sizes, 0).tolist()))
        _, layers, _ = opened.seen(variation, self._cameras)
        nothing = opened.twin.gaussians.select(np.zeros(0, np.int64))
        self._walls = {name: layer.session.picture(nothing).image_srgb for name, layer in layers.items()}

    def draw(self, reached: Reached) -> Images:
        """Image (H, W, 3) of every camera."""
        qpos = self._scene.qpos(reached.joints[None], reached.gripper, reached.theta)[0]
        return {name: self._before_wall(name, camera, qpos) for name, camera in self._cameras.items()}

    def _before_wall(self, name: str, camera: Camera, qpos: Array) -> NDArray[np.uint8]:
        shown, depth = self._renderer.draw(camera, qpos), self._renderer.depths(camera, qpos)
        return np.where((depth < FAR_M)[..., None], shown, self._walls[name])


KINDS: Final[Mapping[str, Any]] = {"splat": SplatViews, "simulator": SimulatorViews}
