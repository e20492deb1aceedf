"""Rooms with a path-traced recording: input of the estimators, and true images of the replaced object."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.io.artifact import read_json
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import Scene
from benchmarks.path_tracer import PathTracedRenderer, RoomLight
from synthetic.demonstration_search import find_demonstration
from synthetic.layout import SceneLayout, build_world
from synthetic.scene_recording import Conditions
from synthetic.world import DEFAULT_ROBOT, capture_rng, draw_object, make_capture

CONDITIONS: Final = Conditions(scan_views=48)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplacedRoom:
    """A recording and the object that replaces the recorded one.

    Attributes:
        category: Category of the recorded object, see `synthetic.world.make_capture`.
        seed: Seed of the capture.
        light: Light of the room.
        asset: Name of the asset in a project.
    """

    category: str
    seed: int
    light: RoomLight
    asset: str


# Lights and tone curves of different kinds: a directional light from the left, a window, a uniform sky.
ROOMS: Final[Mapping[str, ReplacedRoom]] = {
    "lamp": ReplacedRoom(
        category="microwave",
        seed=9200,
        light=RoomLight(environment="interior.exr", lamp_w=60.0, lamp_from=(-1.2, 0.3, 1.6)),
        asset="microwave:41",
    ),
    "window": ReplacedRoom(
        category="cabinet",
        seed=9201,
        light=RoomLight(
            environment="courtyard.exr", strength=0.6, turn=1.0, lamp_w=120.0, lamp_m=1.2,
            lamp_color=(0.8, 0.9, 1.0), lamp_from=(1.6, 0.4, 1.2), view_transform="Filmic",
        ),
        asset="cabinet:41",
    ),
    "sky": ReplacedRoom(
        category="drawer",
        seed=9202,
        light=RoomLight(environment="forest.exr", strength=0.8, turn=2.0, view_transform="Standard"),
        asset="drawer:41",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class RoomTruth:
    """Recording of a room, and images of it with another object.

    Attributes:
        room: The room.
        folder: Folder of `capture`, and of `traced` images, so that none is rendered twice.
    """

    room: ReplacedRoom
    folder: Path

    @property
    def capture(self) -> Path:
        """The recording."""
        return self.folder / "capture"

    @cached_property
    def robot(self) -> RobotModel:
        """Robot of the recording."""
        return load_robot(DEFAULT_ROBOT)

    @cached_property
    def answers(self) -> dict[str, Any]:
        """The recording's `truth.json`."""
        return read_json(self.capture / "truth" / "truth.json")

    @cached_property
    def layout(self) -> SceneLayout:
        """True poses, the recorded object's among them."""
        category, seed = self.room.category, self.room.seed
        return find_demonstration(self.robot, draw_object(category, seed), capture_rng(category, seed)).layout

    def record(self, progress: Progress) -> None:
        """Write the capture, unless it exists."""
        if not self.capture.is_dir():
            make_capture(
                self.capture, category=self.room.category, seed=self.room.seed, conditions=CONDITIONS,
                renderer=self._painter, progress=progress,
            )  # fmt: skip

    def painter(self, asset: ArticulatedAsset, T_world_asset: Array) -> PathTracedRenderer:
        """Make a renderer of the room with an asset instead of the recorded object; the caller closes it."""
        placed = replace(self.layout, asset=asset, T_world_object=T_world_asset)
        return self._painter(build_world(self.robot, placed, visual=True), CONDITIONS.size)

    def camera(self, name: str) -> Camera:
        """Return a scan image's camera by its file name, or a fixed one."""
        answers, (width, height) = self.answers, CONDITIONS.size
        poses = answers["scan"] | answers["demo_cameras"]
        fx, fy, cx, cy = answers["intrinsics"]["scan" if name in answers["scan"] else name]
        return Camera(
            fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, T_world_cam=np.array(poses[name])
        )

    def _painter(self, scene: Scene, size: tuple[int, int]) -> PathTracedRenderer:
        return PathTracedRenderer(scene, size, self.folder / "traced", self.room.light)
