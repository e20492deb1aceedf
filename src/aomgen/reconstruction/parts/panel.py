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


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Where the moving part and the object's box are.

    Attributes:
        T_world_panel: Panel frame (4, 4).
        low, high: Corners (3,) of the moving part, panel frame, [m]. `low[2]` is the seam behind
            the panel; `high[2]` is how far handles reach.
        object_low, object_high: Corners (3,) of the closed object without handles, panel frame, [m].
        beside: How far handles stand out past the panel's left, right, lower and upper edge (4,), where
            the object is not, [m].
    """

    T_world_panel: Array
    low: Array
    high: Array
    object_low: Array
    object_high: Array
    beside: Array = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        freeze(self, "T_world_panel", self.T_world_panel, (4, 4))
        for name in ("low", "high", "object_low", "object_high"):
            freeze(self, name, getattr(self, name), (3,))
        freeze(self, "beside", self.beside, (4,))

    @classmethod
    def of_shape(cls, T_world_panel: Array, shape: Array, margin_m: float) -> Self:
        """A panel from the sixteen numbers that `panel_fit` searches.

        Args:
            T_world_panel: Panel frame (4, 4).
            shape: (16,): left, right, lower and upper edge of the panel, its seam, reach of its
                handles; how far the object goes beyond the panel to the left, right, below and
                above (>= 0); the object's back; how far it stands out beside the panel (>= 0);
                `beside` (>= 0). [m]
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
            beside=shape[12:16],
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
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        low, high = self.object_low, self.object_high
        ours = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
        low, high = self.low, self.high
        deep = (z > low[2]) & (z < high[2])
        moves = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & deep
        if self.beside.any():
            left, right, lower, upper = self.beside
            near = (x > low[0] - left) & (x < high[0] + right) & (y > low[1] - lower) & (y < high[1] + upper)
            moves |= near & deep & ~ours
        if center is not None and center[2] > 0:
            with np.errstate(invalid="ignore", divide="ignore"):
                share = center[2] / (center[2] - z)
                hit_x = center[0] + share * (x - center[0])
                hit_y = center[1] + share * (y - center[1])
            moves |= (
                ours & (z < 0) & (hit_x > low[0]) & (hit_x < high[0]) & (hit_y > low[1]) & (hit_y < high[1])
            )
        return np.where(moves, MOVING, np.where(ours, STATIC, BACKGROUND)).astype(np.uint8)


def lower_face(T_world_panel: Array) -> tuple[int, int]:
    """Axis of the panel frame across the face of a box that looks down most, and its end: 0 low, 1 high."""
    up = T_world_panel[2, :3]
    axis = int(np.argmax(np.abs(up)))
    return axis, 0 if up[axis] > 0 else 1
