"""Images of an episode from a camera that moves: no part of them is static."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import CameraPath
from aomgen.core.values import Array
from aomgen.episodes.fixed_views import crisp_shade
from aomgen.episodes.shading import Shade, States, color_factors, measure_occlusion, shade_on_things
from aomgen.robots.robot import RobotModel
from aomgen.splatting.session import Motion, RenderSession, draw_outputs
from aomgen.twin.twin import TwinModel, moving_layer

# Crisp shadow is followed this far around where the camera is, [m].
NEAR_PATH: Final = 1.5


class MovingView:
    """Images of an object at a pose from a camera that moves: prepared once, then drawn for any states.

    Args:
        twin, robot, threads: As of `render_episode`.
        Ts_world_body: Poses (B, 4, 4) of the twin's bodies in any state.
        path: About where the camera will be, and its optics.
        shades: Soft shadows of object and robot, if any.

    Attributes:
        labels: Of all Gaussians, in the engine's order.
    """

    def __init__(
        self,
        twin: TwinModel,
        robot: RobotModel,
        Ts_world_body: Array,
        path: CameraPath,
        shades: Sequence[Shade],
        threads: int | None,
    ) -> None:
        eyes_world = path.Ts_world_cam[:, :3, 3]
        around = eyes_world[:, None] + NEAR_PATH * np.stack([np.ones(3), -np.ones(3)])
        cast = crisp_shade(twin, robot, Ts_world_body, around.reshape(-1, 3), shades, threads)
        self._shades, self._threads = [*shades, *cast], threads
        self._moving = moving_layer(_with_dark_things(twin, Ts_world_body, eyes_world, shades))
        nothing = twin.gaussians.select(np.zeros(0, np.int64))
        self._session = RenderSession(nothing, path.camera.move(np.eye(4)), threads=threads)
        self.labels = self._moving.labels

    def draw(self, states: States, path: CameraPath, outputs: Sequence[str]) -> dict[str, NDArray]:
        """Images (T, H, W, ...) by output, see `draw_outputs`."""
        motion = self._moving.motion(states.Ts_world_body)
        before = Motion(
            parts=motion.parts,
            Ts_world_part=np.linalg.inv(path.Ts_world_cam)[:, None] @ motion.Ts_world_part,
            colors=motion.colors,
        )
        wanted = {*outputs, *(("alpha", "median_depth", "max_id") if self._shades else ())}
        (images,) = draw_outputs(
            [self._session], self._moving.gaussians, before, tuple(wanted), threads=self._threads
        )
        self._darken(images, states, path)
        return images

    def _darken(self, images: dict[str, NDArray], states: States, path: CameraPath) -> None:
        """Take from the scene's colors the light that shadows take."""
        if not self._shades:
            return
        dark = [shade.dark(states) for shade in self._shades]
        scene = self._moving.bodies == 0
        for t, depth in enumerate(images["median_depth"]):
            shaded = zip(self._shades, dark, strict=True)
            taken = sum(measure_occlusion(shade, maps, t, path.at(t), depth) for shade, maps in shaded)
            factors = np.where(scene[images["max_id"][t]], color_factors(np.asarray(taken)), 1)
            images["rgb8"][t] = np.rint(images["rgb8"][t] * factors[..., None])


def _with_dark_things(
    twin: TwinModel, Ts_world_body: Array, eyes_world: Array, shades: Sequence[Shade]
) -> TwinModel:
    """Twin with the object's shadow on walls and clutter, if it casts one."""
    if not shades:
        return twin
    plane, factors = shades[0].T_world_plane, np.ones((len(twin.bodies), 1))
    still = twin.bodies == 0
    shadow = shade_on_things(twin, Ts_world_body, eyes_world, plane)
    factors[still] = shadow.factors(twin.gaussians.select(still), plane)
    return replace(twin, gaussians=twin.gaussians.brighten(factors))
