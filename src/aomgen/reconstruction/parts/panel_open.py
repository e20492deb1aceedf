"""The shape of an object that was scanned open: its part stands away from the body, each has its own box."""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.conventions import MOVING, STATIC
from aomgen.core.transforms import apply, invert, matrix_from_rotvec, transform
from aomgen.core.values import Array
from aomgen.reconstruction.parts.enclosed import upright_box_axes
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_crops import Crop
from aomgen.reconstruction.parts.panel_front import SCATTER_SHARE
from aomgen.reconstruction.parts.panel_search import BESIDE

# Air behind and before an open panel that holds its inner face and its handle, as shares of its diagonal.
AIR_BEHIND_SHARE, AIR_BEFORE_SHARE = 0.05, 0.15
# Quantiles of what masks of the body show that are its first box.
QUANTILES = (0.02, 0.98)
YAW = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenShapes:
    """Shapes (17,): edges, seam and reach of the panel as in `Panel.of_shape`; the body's low and high corner,
    body frame, [m]; `Panel.around` past the panel's edges; the body's turn about the vertical, [rad].

    Attributes:
        T_world_panel: Panel frame (4, 4).
        T_world_body: Body frame (4, 4) before its turn, z up.
        size: Diagonal of the panel, [m].
    """

    T_world_panel: Array
    T_world_body: Array
    size: float

    def panel(self, shape: Array, skin_m: float) -> Panel:
        left, right, lower, upper, seam, reach = shape[:6]
        turn = transform(matrix_from_rotvec([0, 0, shape[YAW]]), np.zeros(3))
        return Panel(
            T_world_panel=self.T_world_panel,
            low=np.array([left, lower, seam]),
            high=np.array([right, upper, reach]),
            object_low=shape[6:9] - [skin_m, skin_m, 0],
            object_high=shape[9:12] + skin_m,
            around=np.array([*shape[BESIDE], 0.0, 0.0]),
            T_panel_body=invert(self.T_world_panel) @ self.T_world_body @ turn,
        )

    def extent(self, shape: Array) -> float:
        left, right, lower, upper, seam, reach = shape[:6]
        sizes = shape[9:12] - shape[6:9]
        if not (left < right and lower < upper and seam < 0 < reach and (sizes > 0).all()):
            return np.inf
        return float(right - left + upper - lower - seam + sizes.sum() + shape[BESIDE].sum())

    def trials(self, shape: Array, step_m: float) -> list[Array]:
        steps = np.full(len(shape), step_m)
        steps[YAW] = step_m / self.size
        searched = [*range(BESIDE.start), YAW]
        return [sign * steps[k] * np.eye(len(shape))[k] for k in searched for sign in (1.0, -1.0)]

    def bounded(self, shape: Array) -> Array:
        return shape


def open_shapes(
    crops: list[Crop], T_world_panel: Array, size_m: float, closed: list[Array]
) -> list[tuple[OpenShapes, Array]]:
    """First shapes (17,) of open objects: the body level with what its masks show, or along the panel.

    None where nothing of the body is seen.

    Args:
        crops: Prompted images, panel frame.
        T_world_panel: Panel frame (4, 4).
        size_m: Diagonal of the panel, [m].
        closed: First shapes of the closed object; the panel's numbers are theirs.
    """
    body = apply(T_world_panel, np.concatenate([c.inside(masked=True) for c in crops if c.part == STATIC]))
    if not len(body):
        return []
    along = T_world_panel[:2, 0] / np.linalg.norm(T_world_panel[:2, 0])
    starts = []
    for axes in (upright_box_axes(body[:, :2]), np.stack([along, [-along[1], along[0]]], 1)):
        R = np.eye(3)
        R[:2, :2] = axes
        T_world_body = transform(R, np.median(body, 0))
        corners = np.quantile(apply(invert(T_world_body), body), QUANTILES, axis=0)
        shapes = OpenShapes(T_world_panel=T_world_panel, T_world_body=T_world_body, size=size_m)
        starts += [(shapes, np.array([*shape[:6], *corners.ravel(), *np.zeros(5)])) for shape in closed]
    return starts


def with_air(panel: Panel, size_m: float) -> Panel:
    """An open object's panel with what is just before and behind it: handles, and faces of uneven parts.

    Boxes and masks seldom tell how far these reach, and other things are not there.
    """
    air = np.array([0, 0, 0, 0, AIR_BEHIND_SHARE, AIR_BEFORE_SHARE]) * size_m
    return replace(panel, around=panel.around + air)


def panel_size(crops: list[Crop]) -> float:
    """Diagonal of what the moving part's boxes show near the panel's plane, [m]; walls behind do not count."""
    points = np.concatenate([crop.inside(masked=False) for crop in crops if crop.part == MOVING])
    everything = np.linalg.norm(np.diff(np.quantile(points, [0.1, 0.9], axis=0), axis=0))
    near = points[np.abs(points[:, 2]) < SCATTER_SHARE * everything]
    return float(np.linalg.norm(np.diff(np.quantile(near[:, :2], [0.1, 0.9], axis=0), axis=0)))
