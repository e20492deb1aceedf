"""Pictures of a twin from fixed cameras: what never moves is drawn once, what moves stays in its bodies' frames."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.light import Light, shaded_srgb
from aomgen.core.values import Array
from aomgen.splatting.session import Motion, RenderSession
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
class Surface:
    """Relit Gaussians of one body: `albedo_linear` (M, 3) and `transfer` (M, 9), see `twin.Relit`."""

    body: int
    albedo_linear: NDArray[np.float32]
    transfer: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingLayer:
    """The Gaussians of a twin that move, prepared for many frames.

    Attributes:
        gaussians: N, in body frames; relit ones last, in the order of `surfaces`.
        bodies: Body of each (N,) int32.
        surfaces: What is lit anew as it turns.
        light: What surfaces are lit by, world frame, or None.
    """

    gaussians: Gaussians
    bodies: NDArray[np.int32]
    surfaces: tuple[Surface, ...]
    light: Light | None

    def motion(self, Ts_world_body: ArrayLike) -> Motion:
        """The layer's frames for body poses (T, B, 4, 4): Gaussians turn with their bodies, surfaces are lit."""
        Ts = np.asarray(Ts_world_body, np.float64)
        light = self.light
        if light is None or not self.surfaces:
            return Motion(parts=self.bodies, Ts_world_part=Ts)
        colors = [_lit(surface, light, Ts[:, surface.body, :3, :3]) for surface in self.surfaces]
        return Motion(parts=self.bodies, Ts_world_part=Ts, colors=np.concatenate(colors, 1))


def moving_layer(twin: Twin) -> MovingLayer:
    """Prepare what moves in a twin."""
    moving = twin.select(twin.moves)
    bodies, relit = moving.bodies, moving.relit
    row = np.full(len(bodies), -1)  # among the relit Gaussians
    if relit is not None:
        row[relit.indices] = np.arange(len(relit.indices))
    order = np.lexsort((bodies, row >= 0))
    surfaces = []
    if relit is not None:
        lit = order[row[order] >= 0]
        edges = np.searchsorted(bodies[lit], np.arange(len(twin.body_names) + 1))
        for body, (start, end) in enumerate(pairwise(edges.tolist())):
            rows = row[lit[start:end]]
            if len(rows):
                albedo, transfer = relit.albedo_linear[rows], relit.transfer[rows]
                surfaces.append(Surface(body=body, albedo_linear=albedo, transfer=transfer))
    return MovingLayer(
        gaussians=moving.gaussians.select(order),
        bodies=bodies[order],
        surfaces=tuple(surfaces),
        light=None if relit is None else relit.light,
    )


def _lit(surface: Surface, light: Light, Rs_world_body: Array) -> NDArray[np.float32]:
    """sRGB colors (T, M, 3) of a surface in T orientations (T, 3, 3); computed where it has turned."""
    colors = np.empty((len(Rs_world_body), len(surface.albedo_linear), 3), np.float32)
    for t, R in enumerate(Rs_world_body):
        if t and np.array_equal(R, Rs_world_body[t - 1]):
            colors[t] = colors[t - 1]
        else:
            colors[t] = shaded_srgb(surface.albedo_linear, surface.transfer, light.seen_from(R))
    return colors
