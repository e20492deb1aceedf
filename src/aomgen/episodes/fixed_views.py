"""Images of an episode from fixed cameras: static Gaussians are drawn once, moving ones into them, with the shadows."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.values import Array
from aomgen.episodes.arm_shade import ArmShade
from aomgen.episodes.shading import (
    CrispShade,
    DarkMaps,
    Shade,
    ShadedPixels,
    SoftShade,
    States,
    color_factors,
    find_shaded_pixels,
    shade_on_things,
)
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import RenderSession, draw_outputs
from aomgen.twin.plane_shadow import SoftShadow
from aomgen.twin.shadow import FAR, intersect_surface, surface_share
from aomgen.twin.thing_shadow import ThingShadow
from aomgen.twin.twin import StaticLayer, TwinModel, moving_layer, pose_bodies, standing_bodies

# Colors darker than this have no share to speak of, 0..1.
DARK: Final = 1e-4


def soft_shades(
    twin: TwinModel, robot: RobotModel, T_world_object: Array, soft: SoftShadow | None, T_world_plane: Array
) -> list[Shade]:
    """The shadows of the object where it stands, and of the robot, in soft light, if the object is lit."""
    if soft is None:
        return []
    return [SoftShade(twin, T_world_object, soft, T_world_plane), ArmShade(twin, robot, T_world_plane)]


def crisp_shade(
    twin: TwinModel,
    robot: RobotModel,
    Ts_world_body: Array,
    seen_world: Array,
    shades: Sequence[Shade],
    threads: int | None,
) -> list[Shade]:
    """The shadow in a directional light, where there is one; of all of the object, where it throws a new one."""
    if twin.directional_light is None:
        return []
    return [CrispShade(twin, robot, Ts_world_body, seen_world, with_static=bool(shades), threads=threads)]


class FixedViews:
    """Images of an object at a pose from fixed cameras: prepared once, then drawn for any states.

    The images of a state do not depend on other states.

    Args:
        twin, robot, layers, threads: As of `render_episode`.
        Ts_world_body: Poses (B, 4, 4) of the twin's bodies in any state.
        shades: Soft shadows of object and robot, if any.

    Attributes:
        labels: Of all Gaussians, in the engine's order.
    """

    def __init__(
        self,
        twin: TwinModel,
        robot: RobotModel,
        Ts_world_body: Array,
        layers: Mapping[str, StaticLayer],
        shades: Sequence[Shade],
        threads: int | None,
    ) -> None:
        stands = standing_bodies(twin, robot)
        self._threads = threads
        self._moving = moving_layer(twin.select(~stands[twin.bodies]))
        bodies = twin.select(stands[twin.bodies] & twin.moves)
        world = pose_bodies(bodies, Ts_world_body)
        still = concatenate([twin.gaussians.select(~twin.moves), world])
        self._views = [_StillView(layer, world, still, threads) for layer in layers.values()]
        self.labels = np.concatenate([twin.labels[~twin.moves], bodies.labels, self._moving.labels])
        light = twin.directional_light
        seen = [] if light is None else [view.points_on(light.T_world_plane) for view in self._views]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        self._shades = [*shades, *crisp_shade(twin, robot, Ts_world_body, points, shades, threads)]
        if shades:
            plane, eyes = shades[0].T_world_plane, np.stack([item.camera.center for item in layers.values()])
            on_things = shade_on_things(twin, Ts_world_body, eyes, plane)
            for view in self._views:
                view.shade_things(on_things, plane)
        self._pixels = [
            [
                find_shaded_pixels(shade, view.layer.camera, view.layer.depth, view.scene_share)
                for shade in self._shades
            ]
            for view in self._views
        ]

    def draw(self, states: States, outputs: Sequence[str]) -> list[dict[str, NDArray]]:
        """Images (T, H, W, ...) of each camera by output, see `draw_outputs`."""
        dark = [shade.dark(states) for shade in self._shades]
        shaded = zip(self._views, self._pixels, strict=True)
        darkened = [view.darken(pixels, dark) for view, pixels in shaded] if dark else None
        motion = self._moving.motion(states.Ts_world_body)
        sessions = [view.session for view in self._views]
        return draw_outputs(sessions, self._moving.gaussians, motion, outputs, darkened, self._threads)


class _StillView:
    """View of a fixed camera of all that is static in an episode.

    Attributes:
        session: Draws into it what moves.
        layer: Of the scene, without the robot and the object.
        scene_share: How much of each pixel's color (H, W) is of the scene, 0..1: shadows fall on that.

    Args:
        layer: See above.
        bodies: What stands there of robot and object, world frame.
        still: Scene and bodies.
        threads: As of `RenderSession`.
    """

    def __init__(self, layer: StaticLayer, bodies: Gaussians, still: Gaussians, threads: int | None) -> None:
        self.layer, self.session = layer, layer.session
        self.scene_share = np.ones(layer.depth.shape, np.float32)
        self._taken = np.zeros(layer.depth.shape, np.float32)
        if not len(bodies):
            return
        self.session = RenderSession(still, layer.camera, threads=threads)
        alone = layer.session.draw(bodies, shade=np.zeros_like(self.scene_share)).rgb.sum(-1)
        both = self.session.draw(bodies.select(np.zeros(0, np.int64))).rgb.sum(-1)
        self.scene_share = 1 - np.where(both > DARK, alone / np.maximum(both, DARK), 0)

    def shade_things(self, shadow: ThingShadow, T_world_plane: Array) -> None:
        """Let a shadow fall on all but a plane."""
        camera, depth = self.layer.camera, self.layer.depth.astype(np.float64)
        points = camera.center + camera.directions() * np.minimum(depth, FAR)[..., None]
        taken = 1 - surface_share(T_world_plane, points).astype(np.float32)
        things = taken > 0
        taken[things] *= 1 - shadow.at(points[things])
        # Single pixels of an outline may lie behind it.
        self._taken = self.scene_share * median_filter(taken, 3)

    def darken(self, shaded: Sequence[ShadedPixels], dark: Sequence[DarkMaps]) -> NDArray[np.float32]:
        """Factors (T, H, W) on the colors of the scene in shadows; at least one."""
        shape = self.layer.depth.shape
        taken = np.tile(self._taken.ravel(), (len(dark[0].shares), 1))
        for item, maps in zip(shaded, dark, strict=True):
            taken[:, item.pixels] += item.taken(maps)
        return color_factors(taken).reshape(-1, *shape)

    def points_on(self, T_world_plane: Array) -> Array:
        """Visible points of a surface (N, 3)."""
        far = np.minimum(self.layer.depth, FAR).astype(np.float64)
        points, belongs = intersect_surface(T_world_plane, self.layer.camera, far)
        return points[belongs > 0]
