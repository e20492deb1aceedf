"""Labelled images of a scene: rendered as episodes are, with part labels, depth and projected keypoints."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, illuminate_srgb
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import CameraPath
from aomgen.core.gaussians import Gaussians
from aomgen.core.keypoints import find_keypoints, judge_visible, move_keypoints, project_keypoints
from aomgen.core.plan import LightChange
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.camera_views import MovingView
from aomgen.exports.image_clutter import make_clutter, place_clutter
from aomgen.exports.image_scenes import ImageScene, SceneMaker, SceneView
from aomgen.io.artifact import load_artifact
from aomgen.lighting.episode_shadows import States, cast_shadows
from aomgen.lighting.light_estimation import SceneLight, ToneCurve
from aomgen.lighting.object_shadow import tabulate_object_shadow
from aomgen.lighting.reflection import show_in_light
from aomgen.replacement.asset_cover import cover_asset
from aomgen.results import BACKGROUND_FOLDER, Results
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel, trajectory_body_poses
from aomgen.twin.variation import change_appearance, light_gains, scale_object

OUTPUTS: Final = ("rgb8", "alpha", "median_depth", "max_id")
# Distance from the object's footprint that clutter keeps, as a share of the object's half diagonal.
CLUTTER_GAP: Final = 1.1


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSample:
    """One labelled image.

    Attributes:
        image_srgb: (H, W, 3) uint8.
        labels: Visible part (H, W) uint8, see `conventions.PART_LABELS`.
        depth_mm: Depth (H, W) uint16, 0 for none.
        facts: Plain JSON values: camera, object, robot, keypoints.
    """

    image_srgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]
    facts: dict[str, Any]


class ImageRoom:
    """A run's room without its object, in which assets are placed and rendered.

    Args:
        results: Results of a run with the stage "replacement".
        size: Width and height of the images, [px].
        seed: Seed of the clutter.
    """

    def __init__(self, results: Results, size: tuple[int, int], seed: int) -> None:
        self._results, self._size, self._seed = results, size, seed
        self.scenes = SceneMaker(results, size)
        self._background = load_artifact(
            results.folders["replacement"] / BACKGROUND_FOLDER, "twin", TwinModel
        )

    @cached_property
    def _clutter(self) -> Any:
        return make_clutter(np.random.default_rng([self._seed, *b"clutter"]))

    def render(
        self, asset: ArticulatedAsset, facts: dict[str, Any], count: int, rng: np.random.Generator
    ) -> Iterator[ImageSample]:
        """Render `count` labelled images of an asset in random scenes; `facts` are added to those of each.

        Raises:
            ConfigError: The table has no room for the asset.
        """
        scene, placed = self._results.episode_scene, self.scenes.put_in_place(asset)
        light = SceneLight(arriving=scene.light, tone=ToneCurve(), source=scene.light_source)
        T = placed.T_world_asset
        fine, coarse = cover_asset(asset, rng)
        static, moving = (show_in_light(link, light, T[:3, :3]) for link in fine)
        twin = with_object(self._background, static, moving, asset.joint, scene.light, T)
        blocking = with_object(self._background, *coarse, asset.joint, scene.light, T)
        soft = tabulate_object_shadow(blocking, scene.T_world_plane, 1)
        made = 0
        while made < count:
            drawn = self.scenes.draw(placed, rng)
            for sample in self._render_scene(twin, soft, drawn, facts, rng)[: count - made]:
                yield sample
                made += 1

    def _render_scene(
        self, twin: TwinModel, soft: Any, scene: ImageScene, facts: dict[str, Any], rng: np.random.Generator
    ) -> list[ImageSample]:
        variation, robot, T = scene.variation, self._results.robot, scene.T_world_object
        room = self._results.episode_scene
        twin = scale_object(twin, variation.scale)
        for item in self._place_clutter(scene, rng):
            twin = twin.extend(item, 0, BACKGROUND)
        # Its intensity and color are changed in the images, as a camera with fixed exposure sees them.
        turned = replace(LightChange(), turn=variation.light.turn)
        twin = change_appearance(twin, turned, variation.material)
        shown, carried = scene.fixed_views, scene.carried_views
        shadow = soft and soft.scale_by(variation.scale, twin.joint.type == "prismatic")
        eyes = np.stack([view.camera.center for view in shown])
        Ts = self._states(twin, shown[:1], T).Ts_world_body[0]
        twin, shadows = cast_shadows(twin, robot, Ts, eyes, shadow, room.T_world_plane, 1)
        samples = []
        for views in filter(None, (shown, carried)):
            first = views[0].camera
            path = CameraPath(
                camera=first, Ts_world_cam=np.stack([view.camera.T_world_cam for view in views])
            )
            renderer = MovingView(twin, first, shadows, 1)
            images = renderer.draw(self._states(twin, views, T), path, OUTPUTS)
            for k, view in enumerate(views):
                frame = {key: item[k] for key, item in images.items()}
                samples.append(self._label(frame, renderer.labels, view, scene, facts))
        return samples

    def _states(self, twin: TwinModel, views: Sequence[SceneView], T_world_object: Array) -> States:
        states = [view.state for view in views]
        joints, thetas = np.stack([state.joints for state in states]), np.array([s.theta for s in states])
        gripper = np.array([state.gripper for state in states])
        Ts = trajectory_body_poses(twin, self._results.robot, joints, gripper, thetas, T_world_object)
        return States(Ts, thetas)

    def _place_clutter(self, scene: ImageScene, rng: np.random.Generator) -> list[Gaussians]:
        room, asset = self._results.episode_scene, scene.fitted.asset
        low, high = asset.static.bounds
        middle = apply(scene.T_world_object, np.append((low + high)[:2] / 2, 0.0))[:2]
        radius = CLUTTER_GAP * float(np.linalg.norm((high - low)[:2])) / 2
        table = (room.support.low_xy, room.support.high_xy)
        return place_clutter(self._clutter, room.light, room.T_world_plane, table, (middle, radius), rng)

    def _label(
        self,
        frame: dict[str, NDArray],
        labels: NDArray[np.uint8],
        view: SceneView,
        scene: ImageScene,
        facts: dict[str, Any],
    ) -> ImageSample:
        asset, T, camera, state = scene.fitted.asset, scene.T_world_object, view.camera, view.state
        points = apply(T, move_keypoints(find_keypoints(asset), asset.joint, state.theta)[0])
        depth = frame["median_depth"]
        # Pixels with less than half of accumulated alpha show the background.
        parts = np.where(depth > 0, labels[frame["max_id"]], BACKGROUND).astype(np.uint8)
        pixels, _ = project_keypoints(camera, points)
        described = {
            "camera": view.name,
            "K": camera.K.tolist(),
            "T_world_cam": camera.T_world_cam.tolist(),
            "scale": scene.variation.scale,
            "T_world_object": T.tolist(),
            "joint_type": asset.joint.type,
            "theta": state.theta,
            "joints": state.joints.tolist(),
            "gripper": state.gripper,
            "T_world_ee": self._results.robot.ee_poses(state.joints[None])[0].tolist(),
            "points_world": points.tolist(),
            "points_px": pixels.tolist(),
            "visible": judge_visible(camera, points, depth, parts).astype(int).tolist(),
        }
        return ImageSample(
            image_srgb=illuminate_image(frame["rgb8"], light_gains(view.light)),
            labels=parts,
            depth_mm=np.rint(np.clip(1000 * depth, 0, 65535)).astype(np.uint16),
            facts=facts | described,
        )


def illuminate_image(image_srgb: NDArray[np.uint8], gains: Array) -> NDArray[np.uint8]:
    """Multiply the linear colors of an image (H, W, 3) by factors (3,)."""
    levels = illuminate_srgb(np.arange(256)[:, None] / 255, gains)
    table = np.rint(255 * np.minimum(levels, 1)).astype(np.uint8)
    return np.stack([table[image_srgb[..., channel], channel] for channel in range(3)], -1)
