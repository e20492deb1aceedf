"""A moving part as a panel in the front of a box: doors, drawers, flaps and lids.

Masks of such parts are ragged or stop at a window; the panel's rectangle and the object's box are
what makes the borders straight. Frame "panel": x along the panel, y up (or across, for a lid),
z out of the front, origin on the front face.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array, freeze
from aomgen.reconstruction.parts.enclosed import FLOOR_SHARE


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Where the moving part and the object's box are.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        low, high: Corners (3,) of the moving part, panel frame, [m]. `low[2]` is the seam behind
            the panel; `high[2]` is how far handles reach.
        object_low, object_high: Corners (3,) of the object without handles, the moving part included
            when it is closed, body frame, [m].
        around: How far handles stand out past the panel's left, right, lower and upper edge, behind its
            seam and before its reach (6,), where the object is not, [m].
        T_panel_body: Body frame (4, 4): the panel's own for a closed object; upright for an open one,
            whose panel leans or stands away from it.
    """

    T_world_panel: Array
    low: Array
    high: Array
    object_low: Array
    object_high: Array
    around: Array = field(default_factory=lambda: np.zeros(6))
    T_panel_body: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        freeze(self, "T_world_panel", self.T_world_panel, (4, 4))
        for name in ("low", "high", "object_low", "object_high"):
            freeze(self, name, getattr(self, name), (3,))
        freeze(self, "around", self.around, (6,))
        freeze(self, "T_panel_body", self.T_panel_body, (4, 4))

    @property
    def T_world_body(self) -> Array:
        """Body frame (4, 4), world frame."""
        return self.T_world_panel @ self.T_panel_body

    @classmethod
    def of_shape(cls, T_world_panel: Array, shape: Array, margin_m: float) -> Self:
        """A panel from the sixteen numbers that `panel_fit` searches.

        Args:
            T_world_panel: Panel frame (4, 4).
            shape: (16,): left, right, lower and upper edge of the panel, its seam, reach of its
                handles; how far the object goes beyond the panel to the left, right, below and
                above (>= 0); the object's back; how far it stands out beside the panel (>= 0);
                the first four of `around` (>= 0). [m]
            margin_m: Thickness given to the object's outer faces, not to the one that looks down, which
                lies on other things.
        """
        left, right, lower, upper, seam, reach = shape[:6]
        beyond = shape[6:10]
        margins = np.full((2, 3), margin_m)
        axis, side = lower_face(T_world_panel)
        margins[side, axis] = 0.0
        return cls(
            T_world_panel=T_world_panel,
            low=np.array([left, lower, seam]),
            high=np.array([right, upper, reach]),
            object_low=np.array([left - beyond[0], lower - beyond[2], shape[10]]) - margins[0],
            object_high=np.array([right + beyond[1], upper + beyond[3], shape[11]]) + margins[1],
            around=np.array([*shape[12:16], 0.0, 0.0]),
        )

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
        height, width = points_world.shape[:2]
        local = apply(T_panel_world, points_world.reshape(-1, 3)).reshape(height, width, 3)
        return self.labels_local(local, apply(T_panel_world, center_world[None])[0])

    def labels_local(self, local: NDArray, center: Array | None = None) -> NDArray[np.uint8]:
        """As `labels` and, with a camera centre (3,), `labels_seen`, for points in the panel frame."""
        body = local
        if not np.array_equal(self.T_panel_body, np.eye(4)):
            body = apply(invert(self.T_panel_body), local.reshape(-1, 3)).reshape(local.shape)
        # Coordinate by coordinate: the search of a panel spends its time here.
        ours = np.logical_and.reduce(_within(body, self.object_low, self.object_high))
        along, across, deep = _within(local, self.low, self.high)
        moves = along & across & deep
        if self.around.any():
            low, high = self.low - self.around[::2], self.high + self.around[1::2]
            # Past one side, not round a corner: there are other things.
            two_of_three = (along & across) | (along & deep) | (across & deep)
            near = np.logical_and.reduce(_within(local, low, high)) & two_of_three
            moves |= near & ~ours & self._above_floor(body)
        if center is not None and center[2] > 0:
            z = local[..., 2]
            behind = ours & (z < 0)
            share = center[2] / (center[2] - z[behind])
            hit = center[:2] + share[:, None] * (local[behind, :2] - center[:2])
            moves[behind] |= np.logical_and.reduce(_within(hit, self.low, self.high))
        labels = np.full(ours.shape, BACKGROUND, np.uint8)
        labels[ours] = STATIC
        labels[moves] = MOVING
        return labels

    def _above_floor(self, body: NDArray) -> NDArray[np.bool_]:
        """Which points (..., 3) of the body frame are higher than what the object stands on."""
        axis, side = lower_face(self.T_world_body)
        heights = (body[..., axis] - (self.object_low, self.object_high)[side][axis]) * (1, -1)[side]
        return heights > FLOOR_SHARE * (self.object_high[axis] - self.object_low[axis])


def _within(points: NDArray, low: Array, high: Array) -> list[NDArray[np.bool_]]:
    """For each coordinate of points (..., D), which of them lie between two bounds (D or more,)."""
    planes = [points[..., axis] for axis in range(points.shape[-1])]
    return [(x > low[axis]) & (x < high[axis]) for axis, x in enumerate(planes)]


def lower_face(T_world_box: Array) -> tuple[int, int]:
    """Axis of a box's frame across the face of a box that looks down most, and its end: 0 low, 1 high."""
    up = T_world_box[2, :3]
    axis = int(np.argmax(np.abs(up)))
    return axis, 0 if up[axis] > 0 else 1
