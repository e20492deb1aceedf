"""Images of a twin from fixed cameras: what never moves is drawn once, what moves stays in its bodies' frames."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.splatting.session import Motion, RenderSession
from aomgen.twin.relighting import LitSurface, surfaces_of
from aomgen.twin.twin import Twin


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticLayer:
    """What a camera sees without anything that moves.

    Attributes:
        session: Draws the moving Gaussians into it.
        depth: (H, W) float32, median depth, infinite where nothing is, [m].
    """

    session: RenderSession
    depth: NDArray[np.float32]

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.session.camera


def static_layer(gaussians: Gaussians, camera: Camera, threads: int | None = None) -> StaticLayer:
    """Prepare a camera's view of what does not move (world frame); `threads` as in `RenderSession`."""
    session = RenderSession(gaussians, camera, threads=threads)
    drawn = session.draw(gaussians.select(np.zeros(0, np.int64)), with_ids=True)
    median = drawn.median_depth
    depth = drawn.depth if median is None else np.where(median > 0, median, drawn.depth)
    return StaticLayer(session=session, depth=np.where(drawn.alpha > 0.1, depth, np.inf).astype(np.float32))


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingLayer:
    """The Gaussians of a twin that move, prepared for many frames.

    Attributes:
        gaussians: N, in body frames; relit ones last, in the order of `surfaces`.
        bodies: Body of each (N,) int32.
        surfaces: What is lit anew as it turns.
    """

    gaussians: Gaussians
    bodies: NDArray[np.int32]
    surfaces: tuple[LitSurface, ...]

    def motion(self, Ts_world_body: ArrayLike) -> Motion:
        """The layer's frames for body poses (T, B, 4, 4): Gaussians turn with their bodies, surfaces are lit."""
        Ts = np.asarray(Ts_world_body, np.float64)
        if not self.surfaces:
            return Motion(parts=self.bodies, Ts_world_part=Ts)
        colors = [_lit(surface, Ts[:, surface.body, :3, :3]) for surface in self.surfaces]
        return Motion(parts=self.bodies, Ts_world_part=Ts, colors=np.concatenate(colors, 1))


def moving_layer(twin: Twin) -> MovingLayer:
    """Prepare what moves in a twin."""
    moving = twin.select(twin.moves)
    surfaces = surfaces_of(moving.relit, moving.bodies)
    lit = np.zeros(0, np.int64)
    if moving.relit is not None and surfaces:
        lit = moving.relit.indices[np.concatenate([surface.rows for surface in surfaces])]
    unlit = np.ones(len(moving.bodies), bool)
    unlit[lit] = False
    plain = np.flatnonzero(unlit)
    order = np.concatenate([plain[np.argsort(moving.bodies[plain], kind="stable")], lit])
    return MovingLayer(
        gaussians=moving.gaussians.select(order), bodies=moving.bodies[order], surfaces=surfaces
    )


def _lit(surface: LitSurface, Rs_world_body: Array) -> NDArray[np.float32]:
    """sRGB colors (T, M, 3) of a surface in T orientations (T, 3, 3); computed where it has turned."""
    colors = np.empty((len(Rs_world_body), len(surface.rows), 3), np.float32)
    for t, R in enumerate(Rs_world_body):
        if t and np.array_equal(R, Rs_world_body[t - 1]):
            colors[t] = colors[t - 1]
        else:
            colors[t] = surface.colors_srgb(R)
    return colors
