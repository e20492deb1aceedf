"""Refuse ranges in which no object can stand or be held anywhere, before anything is made."""

from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.core.plan import FittedAsset, Variation
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import Unit
from aomgen.episodes.map_drawing import draw_map, front_line, scene_shapes
from aomgen.episodes.reach_map import ReachMap, map_reach
from aomgen.episodes.variations import Ranges
from aomgen.errors import ConfigError
from aomgen.io.atomic import write_text

# Draws of each asset that are looked at: where one in fifty is usable, one is found.
LOOKED_AT: Final = 200
# Nodes along each axis of the map that tells where the arm does reach.
WIDE_NODES: Final = 13
PICTURE: Final = "reach_map.svg"
WORDS: Final = {
    "outside_area": "beside the area",
    "off_table": "off the table",
    "blocked": "where something stands",
    "out_of_reach": "out of the arm's reach",
}


def check_ranges(factory: EpisodeFactory, folder: Path) -> None:
    """Look at the first draws of the assets until one can be used; where none can, write a picture into `folder`.

    An asset that alone finds no place is told of in its account when the others are made.

    Raises:
        ConfigError: Where the first asset's draws are, and where table and arm are.
    """
    homeless = []
    for number, (fitted, found) in enumerate(
        zip(factory.results.fitted_assets, factory.reach_maps, strict=True)
    ):
        reasons = dict[Variation, str]()
        for index in range(LOOKED_AT):
            variation = factory.variation(Unit(asset=number, index=index))
            reasons[variation] = _reason(factory, variation, fitted, found)
            if not reasons[variation]:
                return
        homeless.append((fitted, reasons))
    fitted, reasons = homeless[0]
    raise _refusal(factory, fitted, reasons, folder / PICTURE)


def _reason(factory: EpisodeFactory, variation: Variation, fitted: FittedAsset, found: ReachMap) -> str:
    rejection = factory.place.find_obstruction(variation, fitted)
    if rejection is not None:
        return rejection.reason
    return "" if found.may_reach(variation) else "out_of_reach"


def _refusal(
    factory: EpisodeFactory, fitted: FittedAsset, reasons: dict[Variation, str], picture: Path
) -> ConfigError:
    """What is wrong with the ranges for an asset; the picture shows it."""
    scene, place, ranges = factory.results.episode_scene, factory.place, factory.params.ranges
    (x, y), r = place.reach.shoulder_world[:2], place.reach.reach_m
    around = ((x - r, y - r), (x + r, y - r), (x + r, y + r), (x - r, y + r))
    wide = map_reach(
        fitted,
        factory.results.demonstration,
        Ranges(polygon=around, yaw_deg=ranges.yaw_deg, scale=ranges.scale),
        factory.solver,
        factory.plan_params,
        max_nodes=WIDE_NODES,
    )
    lines = [front_line(fitted, variation, "rejected") for variation in reasons]
    write_text(picture, draw_map([*scene_shapes(scene, [wide]), *lines]))
    places = np.stack([line.points_world[0] for line in lines])
    counted = ", ".join(
        f"{count} {WORDS[reason]}" for reason, count in Counter(reasons.values()).most_common()
    )
    reached = wide.places_world[wide.reached.any(2)]
    reach = (
        f"the arm holds its handle at {_extent(reached)}"
        if len(reached)
        else "the arm holds its handle nowhere"
    )
    table = np.stack([scene.support.low_xy, scene.support.high_xy])
    return ConfigError(
        "episodes.ranges",
        f"no place for {fitted.asset.name}: of {len(reasons)} draws, at {_extent(places)}, {counted}",
        f"{reach}, the free table is {_extent(table)}: {picture} shows both",
    )


def _extent(points: np.ndarray) -> str:
    """The bounds of points (N, 2), in words."""
    (low_x, low_y), (high_x, high_y) = points.min(0), points.max(0)
    return f"x {low_x:.2f} to {high_x:.2f} m, y {low_y:.2f} to {high_y:.2f} m"
