"""Rendering of an episode by fixed and moving cameras: bodies at rest once, moving bodies into it, with shadows."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from aomgen.conventions import illuminate_srgb
from aomgen.core.camera import Camera, CameraPath
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.values import Array
from aomgen.lighting.episode_shadows import States, TableShadow
from aomgen.lighting.plane_shadow import intersect_surface
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.twin.twin import StaticLayer, TwinModel, moving_layer, pose_bodies, standing_bodies

# A share cannot be computed for colors darker than this, sRGB 0..1.
DARK: Final = 1e-4
# Depth of pixels without a surface, [m].
FAR: Final = 60.0


def find_surface(
    T_world_plane: Array, camera: Camera, depth: NDArray[np.float32], scene_share: NDArray
) -> tuple[NDArray[np.int64], NDArray[np.float32], Array]:
    """Find pixels (N,) that show a surface, its share (N,) of their colors, 0..1, and its points (N, 3).

    Args:
        T_world_plane: Pose of the surface.
        camera: The view.
        depth: (H, W), [m].
        scene_share: Share (H, W) of the scene in the pixels' colors, 0..1.
    """
    points, belongs = intersect_surface(T_world_plane, camera, np.minimum(depth, FAR).astype(np.float64))
    share = (belongs * scene_share).ravel()
    pixels = np.flatnonzero(share)
    return pixels, share[pixels].astype(np.float32), points.reshape(-1, 3)[pixels]


class FixedViews:
    """Fixed cameras that show an object at one pose: prepared once, then rendered for any states.

    The images of a state do not depend on the other states.

    Args:
        twin, shadows: Results of `cast_shadows`.
        robot, layers, threads: See `render_episode`.
        Ts_world_body: Poses (B, 4, 4) of the twin's bodies in any state.

    Attributes:
        labels: Labels of all Gaussians, in the engine's order.
    """

    def __init__(
        self,
        twin: TwinModel,
        robot: RobotModel,
        Ts_world_body: Array,
        layers: Mapping[str, StaticLayer],
        shadows: Sequence[TableShadow],
        threads: int | None,
    ) -> None:
        stands = standing_bodies(twin, robot)
        self._moving, self._threads = moving_layer(twin.select(~stands[twin.bodies])), threads
        scene, bodies = twin.select(~twin.moves), twin.select(stands[twin.bodies] & twin.moves)
        still = scene.gaussians, pose_bodies(bodies, Ts_world_body)
        self.labels = np.concatenate([scene.labels, bodies.labels, self._moving.labels])
        self._views = [_FixedView(layer, *still, shadows, threads) for layer in layers.values()]
        # Blocked light is computed for the points of all cameras at once.
        points = [np.concatenate(item) for item in zip(*(view.points for view in self._views), strict=True)]
        self._shadows = [item.prepare(own) for item, own in zip(shadows, points, strict=True)]

    def draw(self, states: States, outputs: Sequence[str]) -> list[dict[str, NDArray]]:
        """Render images (T, H, W, ...) of each camera by output, see `draw_outputs`."""
        blocked = [block(states) for block in self._shadows]
        factors: list[NDArray[np.float32]] = []
        for view in self._views if blocked else ():
            counts = [len(points) for points in view.points]
            factors.append(view.darken([item[:, :n] for item, n in zip(blocked, counts, strict=True)]))
            blocked = [item[:, n:] for item, n in zip(blocked, counts, strict=True)]
        motion = self._moving.motion(states.Ts_world_body)
        sessions = [view.session for view in self._views]
        return draw_outputs(sessions, self._moving.gaussians, motion, outputs, factors or None, self._threads)


class _FixedView:
    """A fixed camera's view of everything that never moves in an episode.

    Attributes:
        session: Renders moving bodies into the view.
        points: Visible points (N, 3) of each shadow's surface.

    Args:
        layer: View of the scene without the robot and the object.
        scene: Gaussians of the scene, in this episode's light.
        bodies: Bodies of robot and object that never move, world frame.
        shadows: Shadows on the scene.
        threads: See `RenderSession`.
    """

    def __init__(
        self,
        layer: StaticLayer,
        scene: Gaussians,
        bodies: Gaussians,
        shadows: Sequence[TableShadow],
        threads: int | None,
    ) -> None:
        self.session, scene_share = layer.session, np.ones(layer.depth.shape, np.float32)
        if len(bodies):
            self.session = RenderSession(concatenate([scene, bodies]), layer.camera, threads=threads)
        both = self.session.draw(bodies.select(np.zeros(0, np.int64))).rgb.mean(-1)
        self._level = np.maximum(both, np.float32(DARK))
        if len(bodies):
            alone = layer.session.draw(bodies, shade=np.zeros_like(scene_share)).rgb.mean(-1)
            scene_share -= np.where(both > DARK, alone / self._level, 0)
        # Single pixels of an outline may show a surface behind it.
        depth = median_filter(layer.depth, 3)
        found = [find_surface(item.T_world_plane, layer.camera, depth, scene_share) for item in shadows]
        self._pixels = np.unique(np.concatenate([np.zeros(0, np.int64), *(item[0] for item in found)]))
        self._places = [np.searchsorted(self._pixels, item[0]) for item in found]
        self._shares = [item[1] for item in found]
        self.points = [item[2] for item in found]

    def darken(self, blocked: Sequence[Array]) -> NDArray[np.float32]:
        """Compute factors (T, H, W) on the scene's sRGB colors from blocked shares (T, N) per shadow."""
        light = np.ones((len(blocked[0]), len(self._pixels)), np.float32)
        for places, share, own in zip(self._places, self._shares, blocked, strict=True):
            light[:, places] -= share * own
        level = self._level.ravel()[self._pixels]
        factors = np.ones((len(light), self._level.size), np.float32)
        factors[:, self._pixels] = illuminate_srgb(level, light) / level
        return factors.reshape(-1, *self._level.shape)


class MovingView:
    """A moving camera that shows an object at one pose: prepared once, then rendered for any states.

    Args:
        twin, shadows: Results of `cast_shadows`.
        camera: Camera, whose optics are used.
        threads: See `render_episode`.

    Attributes:
        labels: Labels of all Gaussians, in the engine's order.
    """

    def __init__(
        self, twin: TwinModel, camera: Camera, shadows: Sequence[TableShadow], threads: int | None
    ) -> None:
        self._shadows, self._threads, self._moving = shadows, threads, moving_layer(twin)
        nothing = twin.gaussians.select(np.zeros(0, np.int64))
        self._session = RenderSession(nothing, camera.move(np.eye(4)), threads=threads)
        self.labels = self._moving.labels

    def draw(self, states: States, path: CameraPath, outputs: Sequence[str]) -> dict[str, NDArray]:
        """Render images (T, H, W, ...) by output, see `draw_outputs`."""
        motion = self._moving.motion(states.Ts_world_body)
        before = Motion(
            parts=motion.parts,
            Ts_world_part=np.linalg.inv(path.Ts_world_cam)[:, None] @ motion.Ts_world_part,
            colors=motion.colors,
        )
        wanted = {*outputs, *(("alpha", "median_depth", "max_id") if self._shadows else ())}
        (images,) = draw_outputs(
            [self._session], self._moving.gaussians, before, tuple(wanted), threads=self._threads
        )
        for t in range(len(states.thetas) if self._shadows else 0):
            self._darken(
                {name: item[t] for name, item in images.items()}, states.part(slice(t, t + 1)), path.at(t)
            )
        return images

    def _darken(self, images: Mapping[str, NDArray], state: States, camera: Camera) -> None:
        """Remove the light that shadows block from the scene's colors in one frame (H, W, ...)."""
        depth, scene = images["median_depth"], (self._moving.bodies == 0)[images["max_id"]]
        light = np.ones(depth.size, np.float32)
        for shadow in self._shadows:
            pixels, share, points = find_surface(shadow.T_world_plane, camera, depth, scene)
            light[pixels] -= share * shadow.prepare(points)(state)[0]
        pixels, colors = np.flatnonzero(light != 1), images["rgb8"].reshape(-1, 3)
        lit = illuminate_srgb(colors[pixels] / 255, light[pixels, None])
        colors[pixels] = np.rint(255 * np.minimum(lit, 1))
