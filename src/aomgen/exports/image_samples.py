"""Labeled images of random scenes, rendered like episodes, with part labels, depth and projected keypoints."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.exposure import change_exposure
from aomgen.core.keypoints import find_keypoints, move_keypoints, project_keypoints
from aomgen.core.plan import FittedAsset, LightChange
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.render import ImageParams, render_episode, static_layers
from aomgen.exports.image_clutter import Clutter, ClutterPlacer, find_footprint, make_clutter
from aomgen.exports.image_scenes import SceneMaker
from aomgen.io.artifact import load_artifact
from aomgen.io.images import encode_jpeg, encode_png
from aomgen.lighting.light_estimation import SceneLight, ToneCurve
from aomgen.lighting.object_shadow import ObjectShadow, tabulate_object_shadow
from aomgen.lighting.reflection import show_in_light
from aomgen.replacement.asset_cover import cover_asset
from aomgen.results import BACKGROUND_FOLDER, Results
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel
from aomgen.twin.variation import change_appearance, light_gains, scale_object

OUTPUTS: Final = ImageParams(depth=True, labels=True)
# Degree of the spherical harmonics of colors; higher degrees render reflections better and double the time.
SH_DEGREE: Final = 1
# The same quality as in RLDS, at least 36 dB.
JPEG_QUALITY: Final = 95
# Compression level of PNG; compared with higher levels it saves a few milliseconds per image at 10 % more bytes.
PNG_LEVEL: Final = 1


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
        scene = results.episode_scene
        self._placer = ClutterPlacer(scene.light, scene.T_world_plane, self._scenes.table)
        self._background = replace(twin, gaussians=twin.gaussians.with_sh_degree(SH_DEGREE))

    @cached_property
    def _clutter(self) -> list[Clutter]:
        return make_clutter(np.random.default_rng([self._seed, *b"clutter"]))

    def render(
        self, asset: ArticulatedAsset, facts: dict[str, Any], count: int, rng: np.random.Generator
    ) -> Iterator[dict[str, bytes]]:
        """Yield `count` labeled images of an asset in random scenes, as files by suffix; `facts` are added to their JSON.

        Raises:
            ConfigError: The asset does not fit on the table.
        """
        scene, placed = self._results.episode_scene, self._scenes.put_in_place(asset)
        light = SceneLight(arriving=scene.light, tone=ToneCurve(), source=scene.light_source)
        T = placed.T_world_asset
        fine, coarse = cover_asset(asset, rng)
        lit = (show_in_light(link, light, T[:3, :3]) for link in fine)
        static, moving = (replace(item, gaussians=item.gaussians.with_sh_degree(SH_DEGREE)) for item in lit)
        twin = with_object(self._background, static, moving, asset.joint, scene.light, T)
        blocking = with_object(self._background, *coarse, asset.joint, scene.light, T)
        soft = tabulate_object_shadow(blocking, scene.T_world_plane, 1)
        images = (
            image for _ in itertools.count() for image in self._render_scene(twin, soft, placed, facts, rng)
        )
        yield from itertools.islice(images, count)

    def _render_scene(
        self,
        twin: TwinModel,
        soft: ObjectShadow | None,
        placed: FittedAsset,
        facts: dict[str, Any],
        rng: np.random.Generator,
    ) -> Iterator[dict[str, bytes]]:
        """Yield the labeled images of one random scene, as files by suffix."""
        variation, fitted, states = self._scenes.draw(placed, rng)
        cameras, paths = dict(self._scenes.draw_cameras(rng)), dict(self._scenes.draw_paths(states, rng))
        robot, asset, T = self._results.robot, fitted.asset, states.T_world_object
        twin = scale_object(twin, variation.scale)
        taken = find_footprint(fitted, T)
        for item in self._placer.place(self._clutter, asset.category, T[:3, :3], taken, rng):
            twin = twin.extend(item, 0, BACKGROUND)
        # Brightness and color of the light are changed in the images, for a camera with fixed exposure.
        turned = replace(LightChange(), turn=variation.light.turn)
        twin = change_appearance(twin, turned, variation.material)
        points = apply(T, move_keypoints(find_keypoints(asset), asset.joint, states.thetas))
        drawn = render_episode(
            twin,
            robot,
            states,
            static_layers(twin, cameras, 1),
            self._results.episode_scene.T_world_plane,
            1,
            soft=soft and soft.scale_by(variation.scale, twin.joint.type == "prismatic"),
            paths=paths,
            points_world=points,
            params=OUTPUTS,
        )
        Ts_world_ee = states.ee_poses(robot)
        for name, frames in drawn.items():
            labels, depth_mm, visible = map(np.asarray, (frames.labels, frames.depth_mm, frames.visible))
            for t, image in enumerate(frames.images_srgb):
                camera = paths[name].at(t) if name in paths else cameras[name]
                stated = {
                    **facts,
                    **_describe_view(name, camera, points[t], visible[t]),
                    "scale": variation.scale,
                    "T_world_object": T.tolist(),
                    "joint_type": asset.joint.type,
                    "theta": float(states.thetas[t]),
                    "joints": states.joints[t].tolist(),
                    "gripper": float(states.gripper[t]),
                    "T_world_ee": Ts_world_ee[t].tolist(),
                }
                lit = change_exposure(image, light_gains(self._scenes.draw_light(rng)))
                yield {
                    "jpg": encode_jpeg(lit, JPEG_QUALITY, halve_colors=False),
                    "labels.png": encode_png(labels[t], PNG_LEVEL),
                    "depth.png": encode_png(depth_mm[t], PNG_LEVEL),
                    "json": json.dumps(stated, allow_nan=False).encode(),
                }


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
