"""Pairs of images of a room with a replaced object: rendered by the twin, and path traced."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.episode import NEW_CAMERA
from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import transform
from aomgen.core.values import Array
from aomgen.episodes.render import render_episode, static_layers
from aomgen.io.artifact import load_artifact
from aomgen.results import BACKGROUND_FOLDER, Results
from aomgen.simulation.scene_renderer import SceneRenderer
from aomgen.twin.twin import TwinModel
from benchmarks.replace_rooms import CONDITIONS, RoomTruth
from synthetic.layout import build_world

# Positions in the walk, as shares of its length: left, front and right, low and high.
VIEWS: Final = (0.08, 0.22, 0.4, 0.6, 0.75, 0.95)
# Pose far away and below the floor, [m].
AWAY: Final = transform(np.eye(3), np.array([50.0, 50.0, -50.0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A state that is rendered from all cameras.

    Attributes:
        joints, gripper: State of the robot.
        theta: Joint value of the new object; None without an object.
    """

    joints: Array
    gripper: float
    theta: float | None


@dataclass(frozen=True)
class RoomPictures:
    """Images of shots of a finished run's first asset, and of the truth.

    Attributes:
        truth: The room.
        results: Results of its run, up to the replaced object.
    """

    truth: RoomTruth
    results: Results

    @cached_property
    def fitted(self) -> FittedAsset:
        """The asset at its pose."""
        return self.results.fitted_assets[0]

    @cached_property
    def twin(self) -> TwinModel:
        """Twin with the asset."""
        return load_artifact(self.results.asset_folder(0), "twin", TwinModel)

    @cached_property
    def background(self) -> TwinModel:
        """Twin without an object."""
        return load_artifact(self.results.folders["replacement"] / BACKGROUND_FOLDER, "twin", TwinModel)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """True cameras of the scan, fixed ones, and the episodes' new viewpoint."""
        names = sorted(self.truth.answers["scan"])
        chosen = [names[int(share * (len(names) - 1))] for share in VIEWS]
        side = self.results.episode_scene.cameras[NEW_CAMERA].resize(*CONDITIONS.size)
        recorded = {name: self.truth.camera(name) for name in [*chosen, self.results.demo_camera]}
        return {**recorded, NEW_CAMERA: side}

    @cached_property
    def shots(self) -> dict[str, Shot]:
        """Shots: the arm at rest and at its first grasp; the object absent, closed, and open."""
        rest, demo = self.results.configuration, self.results.demonstration
        held = int(demo.contact_frames[0])
        at_rest = {"joints": rest.joints, "gripper": rest.gripper}
        reached = {"joints": demo.joints[held], "gripper": float(demo.gripper[held])}
        return {
            "empty": Shot(**at_rest, theta=None),
            "closed": Shot(**at_rest, theta=0.0),
            "open": Shot(
                **at_rest, theta=float(np.abs([self.fitted.start_theta, self.fitted.target_theta]).max())
            ),
            "empty_reached": Shot(**reached, theta=None),
        }

    def draw(
        self, shot: Shot, *, twin: TwinModel | None = None, shadow: bool = True
    ) -> dict[str, NDArray[np.uint8]]:
        """Render images (H, W, 3) of the twin, or another one, from each camera."""
        twin = twin or self.twin
        trajectory = SceneTrajectory(
            times_s=np.zeros(1),
            joints=shot.joints[None],
            gripper=np.array([shot.gripper]),
            thetas=np.array([shot.theta or 0.0]),
            T_world_object=AWAY if shot.theta is None else self.fitted.T_world_asset,
        )
        plane = self.results.episode_scene.T_world_plane if shadow else None
        layers = static_layers(twin, self.cameras)
        frames = render_episode(twin, self.results.robot, trajectory, layers, plane)
        return {name: item.images_srgb[0] for name, item in frames.items()}

    def trace(self) -> dict[str, dict[str, NDArray[np.uint8]]]:
        """Render path-traced images (H, W, 3), by shot and camera."""
        with self.truth.painter(self.fitted.asset, self.fitted.T_world_asset) as painter:
            found = {}
            for name, shot in self.shots.items():
                qpos = painter.scene.qpos(shot.joints[None], shot.gripper, shot.theta or 0.0)[0]
                without = ("object_",) if shot.theta is None else ()
                found[name] = {key: painter.draw(item, qpos, without) for key, item in self.cameras.items()}
            return found


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenGeometry:
    """Labels of the true images, by camera (H, W).

    Attributes:
        labels: Parts, see `conventions.PART_LABELS`.
        depths: Along the optical axis, [m].
    """

    labels: Mapping[str, NDArray[np.uint8]]
    depths: Mapping[str, Array]


def see_geometry(
    pictures: RoomPictures, shot: Shot, cameras: Mapping[str, Camera], *, recorded: bool = False
) -> SeenGeometry:
    """Render labels and depths of a shot, with the recorded object instead of the new one if `recorded`."""
    layout = pictures.truth.layout
    if not recorded:
        layout = replace(
            layout,
            asset=pictures.fitted.asset,
            T_world_object=AWAY if shot.theta is None else pictures.fitted.T_world_asset,
        )
    scene = build_world(pictures.truth.robot, layout, visual=True)
    qpos = scene.qpos(shot.joints[None], shot.gripper, 0.0 if recorded else shot.theta or 0.0)[0]
    with SceneRenderer(scene, CONDITIONS.size) as renderer:
        return SeenGeometry(
            labels={name: renderer.labels(camera, qpos) for name, camera in cameras.items()},
            depths={name: renderer.depths(camera, qpos) for name, camera in cameras.items()},
        )
