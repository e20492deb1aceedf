"""Labeled images of random scenes, rendered like episodes, with part labels, depth and projected keypoints."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, illuminate_srgb
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.keypoints import find_keypoints, move_keypoints, project_keypoints
from aomgen.core.plan import LightChange
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.render import ImageParams, render_episode, static_layers
from aomgen.exports.image_clutter import make_clutter, place_clutter
from aomgen.exports.image_scenes import ImageScene, SceneMaker
from aomgen.io.artifact import load_artifact
from aomgen.lighting.light_estimation import SceneLight, ToneCurve
from aomgen.lighting.object_shadow import ObjectShadow, tabulate_object_shadow
from aomgen.lighting.reflection import show_in_light
from aomgen.replacement.asset_cover import cover_asset
from aomgen.results import BACKGROUND_FOLDER, Results
from aomgen.splatting.surfels import Surfels
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel
from aomgen.twin.variation import change_appearance, light_gains, scale_object

OUTPUTS: Final = ImageParams(depth=True, labels=True)
# Smallest distance of clutter from the object's center, relative to half the diagonal of its footprint.
CLUTTER_GAP: Final = 1.1
# Degree of the spherical harmonics of colors; higher degrees render reflections better and double the time.
SH_DEGREE: Final = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSample:
    """One labeled image.

    Attributes:
        image_srgb: (H, W, 3) uint8.
        labels: Label of the visible part (H, W) uint8, see `conventions.PART_LABELS`.
        depth_mm: Depth (H, W) uint16, [mm]; 0 if unknown.
        facts: JSON values of camera, object, robot and keypoints.
    """

    image_srgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]
    facts: dict[str, Any]


class ImageRoom:
    """Scene of a run without its object, in which assets are placed and rendered.

    Args:
        results: Results of a run with the stage "replacement".
        size: Width and height of the images, [px].
        seed: Seed of the clutter.
    """

    def __init__(self, results: Results, size: tuple[int, int], seed: int) -> None:
        self._results, self._seed = results, seed
        self._scenes = SceneMaker(results, size)
        home = results.folders["replacement"] / BACKGROUND_FOLDER
        twin = load_artifact(home, "twin", TwinModel)
        self._background = replace(twin, gaussians=twin.gaussians.with_sh_degree(SH_DEGREE))

    @cached_property
    def _clutter(self) -> list[Surfels]:
        return make_clutter(np.random.default_rng([self._seed, *b"clutter"]))

    def render(
        self, asset: ArticulatedAsset, facts: dict[str, Any], count: int, rng: np.random.Generator
    ) -> Iterator[ImageSample]:
        """Render `count` labeled images of an asset in random scenes; `facts` are added to those of each image.

        Raises:
            ConfigError: The asset does not fit on the table.
        """
        scene, placed = self._results.episode_scene, self._scenes.put_in_place(asset)
        light = SceneLight(arriving=scene.light, tone=ToneCurve(), source=scene.light_source)
        T = placed.T_world_asset
        fine, coarse = cover_asset(asset, rng)
        static, moving = (_lower(show_in_light(link, light, T[:3, :3])) for link in fine)
        twin = with_object(self._background, static, moving, asset.joint, scene.light, T)
        blocking = with_object(self._background, *coarse, asset.joint, scene.light, T)
        soft = tabulate_object_shadow(blocking, scene.T_world_plane, 1)
        made = 0
        while made < count:
            drawn = self._scenes.draw(placed, rng)
            for sample in self._render_scene(twin, soft, drawn, rng):
                if made < count:
                    yield replace(sample, facts=facts | sample.facts)
                made += 1

    def _render_scene(
        self, twin: TwinModel, soft: ObjectShadow | None, scene: ImageScene, rng: np.random.Generator
    ) -> Iterator[ImageSample]:
        variation, robot, states = scene.variation, self._results.robot, scene.states
        twin = scale_object(twin, variation.scale)
        for item in self._place_clutter(scene, rng):
            twin = twin.extend(item, 0, BACKGROUND)
        # Brightness and color of the light are changed in the images, for a camera with fixed exposure.
        turned = replace(LightChange(), turn=variation.light.turn)
        twin = change_appearance(twin, turned, variation.material)
        asset, T = scene.fitted.asset, scene.states.T_world_object
        points = apply(T, move_keypoints(find_keypoints(asset), asset.joint, states.thetas))
        drawn = render_episode(
            twin,
            robot,
            states,
            static_layers(twin, scene.cameras, 1),
            self._results.episode_scene.T_world_plane,
            1,
            soft=soft and soft.scale_by(variation.scale, twin.joint.type == "prismatic"),
            paths=scene.paths,
            points_world=points,
            params=OUTPUTS,
        )
        Ts_world_ee = states.ee_poses(robot)
        for name, frames in drawn.items():
            labels, depth_mm, visible = map(np.asarray, (frames.labels, frames.depth_mm, frames.visible))
            for t, image in enumerate(frames.images_srgb):
                camera = scene.paths[name].at(t) if name in scene.paths else scene.cameras[name]
                facts = _describe_view(name, camera, points[t], visible[t]) | {
                    "scale": variation.scale,
                    "T_world_object": T.tolist(),
                    "joint_type": asset.joint.type,
                    "theta": float(states.thetas[t]),
                    "joints": states.joints[t].tolist(),
                    "gripper": float(states.gripper[t]),
                    "T_world_ee": Ts_world_ee[t].tolist(),
                }
                yield ImageSample(
                    image_srgb=illuminate_image(image, light_gains(self._scenes.draw_light(rng))),
                    labels=labels[t],
                    depth_mm=depth_mm[t],
                    facts=facts,
                )

    def _place_clutter(self, scene: ImageScene, rng: np.random.Generator) -> list[Gaussians]:
        room, asset = self._results.episode_scene, scene.fitted.asset
        low, high = asset.static.bounds
        middle = apply(scene.states.T_world_object, np.append((low + high)[:2] / 2, 0.0))[:2]
        taken = middle, CLUTTER_GAP * float(np.linalg.norm((high - low)[:2])) / 2
        return place_clutter(self._clutter, room.light, room.T_world_plane, self._scenes.table, taken, rng)


def illuminate_image(image_srgb: NDArray[np.uint8], gains: Array) -> NDArray[np.uint8]:
    """Multiply the linear colors of an image (H, W, 3) by factors (3,)."""
    levels = illuminate_srgb(np.arange(256)[:, None] / 255, gains)
    table = np.rint(255 * np.minimum(levels, 1)).astype(np.uint8)
    return np.stack([table[image_srgb[..., channel], channel] for channel in range(3)], -1)


def _lower(surfels: Surfels) -> Surfels:
    return replace(surfels, gaussians=surfels.gaussians.with_sh_degree(SH_DEGREE))


def _describe_view(
    name: str, camera: Camera, points_world: Array, visible: NDArray[np.bool_]
) -> dict[str, Any]:
    """Describe a camera and keypoints (5, 3) in its image."""
    return {
        "camera": name,
        "K": camera.K.tolist(),
        "T_world_cam": camera.T_world_cam.tolist(),
        "points_world": points_world.tolist(),
        "points_px": project_keypoints(camera, points_world)[0].tolist(),
        "visible": visible.astype(int).tolist(),
    }
