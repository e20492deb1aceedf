"""The table from above, as SVG: what stands there, where the arm reaches, where objects stood or may stand."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from scipy.spatial import ConvexHull

from aomgen.core.demonstration import EpisodeScene
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze_arrays
from aomgen.episodes.reach_map import ReachMap

# Width of a map, [px], and room around what is drawn, [m].
WIDTH, ROOM_M = 480, 0.08
# Length of a line that tells where an object's front looks, [m].
LINE_M: Final = 0.06
OUTCOMES: Final = {"committed": "#2c7a4b", "rejected": "#d1495b", "skipped": "#b9c2cf"}
TABLE, OBSTACLE, REACHED = "#f3ead9", "#8a8f98", "#57b894"
# How strongly a place is colored that the arm reaches in every turn, 0..1.
REACHED_OPACITY: Final = 0.7
# Of the square of a place that has no other beside it, [m].
LEAST_HALF_M: Final = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A polygon (N, 2) or, with `dot`, a line with a dot at its first point; world frame, [m]."""

    points_world: Annotated[Array, "_ 2"]
    color: str
    opacity: float = 1.0
    outline: bool = False
    dot: bool = False

    __post_init__ = freeze_arrays


def scene_shapes(scene: EpisodeScene, maps: Sequence[ReachMap]) -> list[Shape]:
    """The known table, where the arm reaches (the stronger, the more turns of the object and maps), and obstacles."""
    shapes = []
    low, high = scene.support.low_xy, scene.support.high_xy
    if np.isfinite([low, high]).all():
        corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        shapes.append(Shape(points_world=corners, color=TABLE))
    for found in maps:
        shapes += _mark_reached_places(found, REACHED_OPACITY / len(maps))
    for box in scene.obstacles:
        corners = box.corners()[:, :2]
        shapes.append(Shape(points_world=corners[ConvexHull(corners).vertices], color=OBSTACLE))
    return shapes


def draw_map(shapes: Iterable[Shape]) -> str:
    """Shapes in order, the last on top; the robot's base is a cross at the origin, x points to the right, y up."""
    shapes = list(shapes)
    points = np.concatenate([np.zeros((1, 2)), *(shape.points_world for shape in shapes)])
    low, high = points.min(0) - ROOM_M, points.max(0) + ROOM_M
    scale = WIDTH / (high[0] - low[0])
    height = scale * (high[1] - low[1])

    def at(point: Array) -> str:
        return f"{scale * (point[0] - low[0]):.1f},{height - scale * (point[1] - low[1]):.1f}"

    drawn = []
    for shape in shapes:
        corners = " ".join(map(at, shape.points_world))
        if shape.dot:
            drawn.append(
                f'<polyline points="{corners}" stroke="{shape.color}" stroke-width="2" fill="none"/>'
                f'<circle r="3" fill="{shape.color}" transform="translate({at(shape.points_world[0])})"/>'
            )
        elif shape.outline:
            drawn.append(f'<polygon points="{corners}" fill="none" stroke="{shape.color}" stroke-width="2"/>')
        else:
            drawn.append(
                f'<polygon points="{corners}" fill="{shape.color}" fill-opacity="{shape.opacity:.2f}"/>'
            )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" style="max-width:{WIDTH}px">'
        f'{"".join(drawn)}<path d="M{at(np.zeros(2))}m-7,0h14m-7,-7v14" stroke="#1c2430" stroke-width="2"/></svg>'
    )


def front_line(fitted: FittedAsset, variation: Variation, outcome: str) -> Shape:
    """From the middle of an object to before its front, in the color of what came of its draw."""
    ends = np.stack([fitted.middle_asset, fitted.middle_asset - [0.0, LINE_M, 0.0]])
    return Shape(
        points_world=apply(variation.place_at(fitted), ends)[:, :2], color=OUTCOMES[outcome], dot=True
    )


def _mark_reached_places(found: ReachMap, opacity: float) -> list[Shape]:
    """A square about each place that is reached in some turn."""
    places, shares = found.places_world, found.reached.mean(2)
    gaps = [np.linalg.norm(np.diff(places, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    half = min((gap[gap > 0].min() / 2 for gap in gaps if (gap > 0).any()), default=LEAST_HALF_M)
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return [
        Shape(points_world=place + square, color=REACHED, opacity=opacity * share)
        for place, share in zip(places.reshape(-1, 2), shares.ravel(), strict=True)
        if share > 0
    ]
