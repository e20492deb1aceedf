"""An object as two boxes: the moving part, a panel, and the body.

Masks of doors, drawers and lids are ragged or stop at a window; the boxes make the borders straight.
Panel frame: x level along the panel, y up (across, for a lid), z out of the front, origin on the front face.
Body frame: z up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, Matrix4, Vector3, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Where the two boxes are; what lies in both belongs to the moving part.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        low, high: Corners (3,) of the moving part, panel frame, [m]. `low[2]` is the seam behind
            the panel; `high[2]` is how far handles reach.
        T_panel_body: Body frame (4, 4), panel frame.
        body_low, body_high: Corners (3,) of the object's body, body frame, [m].
    """

    T_world_panel: Matrix4
    low: Vector3
    high: Vector3
    T_panel_body: Matrix4
    body_low: Vector3
    body_high: Vector3

    __post_init__ = freeze_arrays

    def labels(self, points_world: ArrayLike) -> NDArray[np.uint8]:
        """Part labels (N,) of points (N, 3) by where they are, world frame."""
        return self.labels_local(apply(invert(self.T_world_panel), np.asarray(points_world, np.float64)))

    def labels_seen(self, points_world: Array, center_world: Array) -> NDArray[np.uint8]:
        """Part labels (H, W) of what a camera sees.

        Args:
            points_world: (H, W, 3) surface point at each pixel; NaN for none.
            center_world: The camera's centre (3,).

        A panel is opaque: what appears behind its face, mirrored or seen through glass, is it.
        """
        T_panel_world = invert(self.T_world_panel)
        local = apply(T_panel_world, points_world.reshape(-1, 3)).reshape(points_world.shape)
        return self.labels_local(local, apply(T_panel_world, center_world[None])[0])

    def labels_local(self, local: NDArray, center: Array | None = None) -> NDArray[np.uint8]:
        """As `labels` and, with a camera centre (3,), `labels_seen`, for points (..., 3) in the panel frame."""
        T_body_panel = invert(self.T_panel_body)
        # Coordinate by coordinate: the search of a panel spends its time here.
        x, y, z = (local[..., axis] for axis in range(3))
        body = [row[0] * x + row[1] * y + row[2] * z + row[3] for row in T_body_panel[:3]]
        ours = np.logical_and.reduce(_within(body, self.body_low, self.body_high))
        moves = np.logical_and.reduce(_within([x, y, z], self.low, self.high))
        if center is not None and center[2] > 0:
            behind = ours & (z < 0)
            share = center[2] / (center[2] - z[behind])
            hit = [center[k] + share * (plane[behind] - center[k]) for k, plane in enumerate((x, y))]
            moves[behind] |= np.logical_and.reduce(_within(hit, self.low, self.high))
        labels = np.full(ours.shape, BACKGROUND, np.uint8)
        labels[ours] = STATIC
        labels[moves] = MOVING
        return labels

    def faces(self) -> list[tuple[Array, float]]:
        """The planes of all twelve faces, `normal @ x = offset`, world frame."""
        planes = []
        for T_world_box, low, high in (
            (self.T_world_panel, self.low, self.high),
            (self.T_world_panel @ self.T_panel_body, self.body_low, self.body_high),
        ):
            for axis in range(3):
                normal = T_world_box[:3, axis]
                at_origin = float(normal @ T_world_box[:3, 3])
                planes += [(normal, at_origin + float(edge)) for edge in (low[axis], high[axis])]
        return planes

    @property
    def uncovered_m(self) -> float:
        """How far the panel's corners stand out past the body's footprint, mean over the corners, [m]."""
        corners = [[x, y, 0.0] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])]
        body = apply(invert(self.T_panel_body), np.array(corners))
        beyond = np.maximum(np.maximum(self.body_low - body, body - self.body_high), 0)
        return float(beyond[:, :2].sum(1).mean())


def _within(planes: list[NDArray], low: Array, high: Array) -> list[NDArray[np.bool_]]:
    """For each coordinate, which of its values lie between two bounds (D or more,)."""
    return [(values > low[axis]) & (values < high[axis]) for axis, values in enumerate(planes)]
