"""How a synthetic capture is recorded: noise, what the recording states, and where its cameras stand."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.synthetic.layout import SceneLayout


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Cameras and their flaws.

    Attributes:
        size: Width and height of stills and video, [px].
        scan_views: Number of stills.
        fps: Of the video.
        focal_share: Focal length over image width; a phone's main camera has about 0.94.
        noise: Sensor noise, 1 = a phone in a bright room.
        gain_spread: Largest relative change of exposure between stills.
        intrinsics_known: Whether capture.toml states them.
    """

    size: tuple[int, int] = (320, 240)
    scan_views: int = 40
    fps: int = 10
    focal_share: float = 0.9375
    noise: float = 1.0
    gain_spread: float = 0.03
    intrinsics_known: bool = True


def draw_conditions(rng: np.random.Generator) -> Conditions:
    """Conditions as recordings differ in them: lens, picture size, light, length of the walk."""
    return Conditions(
        size=((320, 240), (400, 300), (384, 256))[rng.integers(3)],
        scan_views=int(rng.integers(40, 57)),
        fps=int(rng.choice([10, 12, 15])),
        focal_share=rng.uniform(0.8, 1.0),
        noise=rng.uniform(0.6, 2.0),
        gain_spread=rng.uniform(0.01, 0.06),
    )


def pinhole(conditions: Conditions, T_world_cam: Array) -> Camera:
    """The camera that all pictures of a capture share, at a pose."""
    width, height = conditions.size
    focal = conditions.focal_share * width
    return Camera(
        fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height, T_world_cam=T_world_cam
    )


def scan_cameras(layout: SceneLayout, conditions: Conditions, rng: np.random.Generator) -> list[Camera]:
    """A hand-held walk in three arcs around robot and object, low to high."""
    x, y = _object_place(layout)
    target = np.array([0.6 * x, 0.58 * y, layout.room.table_z + 0.12])
    arcs = np.array_split(np.arange(conditions.scan_views), 3)
    cameras = []
    for number, arc in enumerate(arcs):
        sweep = np.linspace(-1.0, 1.0, len(arc)) * (1 if number % 2 == 0 else -1)
        for share in sweep:
            angle = np.deg2rad(98.0 * share + rng.uniform(-3, 3))
            radius = (1.22, 1.18, 1.05)[number] + rng.uniform(-0.06, 0.06)
            height = layout.room.table_z + (0.32, 0.58, 0.95)[number] + rng.uniform(-0.05, 0.05)
            eye = np.array([target[0] + radius * np.sin(angle), target[1] - radius * np.cos(angle), height])
            aim = target + rng.uniform(-0.07, 0.07, 3)
            cameras.append(_in_room(layout, conditions, eye, aim))
    return cameras


def demo_candidates(layout: SceneLayout, conditions: Conditions, rng: np.random.Generator) -> list[Camera]:
    """Places for the fixed camera, left and right of the robot, all see the front of the object."""
    x, y = _object_place(layout)
    target = np.array([0.8 * x, 0.68 * y, layout.room.table_z + 0.13])
    cameras = []
    for side in (-1.0, 1.0, -1.0, 1.0):
        height = layout.room.table_z + rng.uniform(0.5, 0.8)
        eye = np.array([target[0] + side * rng.uniform(0.85, 1.15), rng.uniform(-0.4, 0.0), height])
        cameras.append(_in_room(layout, conditions, eye, target + rng.uniform(-0.04, 0.04, 3)))
    return cameras


def _object_place(layout: SceneLayout) -> tuple[float, float]:
    """Middle of the object on the table (x, y), room frame, [m]."""
    place = apply(invert(layout.room.T_world_room), layout.T_world_object[:3, 3])
    return float(place[0]), float(place[1])


def _in_room(layout: SceneLayout, conditions: Conditions, eye_room: Array, target_room: Array) -> Camera:
    T = layout.room.T_world_room
    return pinhole(conditions, look_at(apply(T, eye_room), apply(T, target_room)))
