"""Coverage of the requested ranges by the episodes of a run, and the largest areas without an episode."""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.plan import FittedAsset
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.ledger import Distribution, distributions, unit_of
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.reach_map import LINE_M, REACH_MAP, ReachMap, scene_shapes
from aomgen.episodes.variations import Ranges, inside
from aomgen.io.artifact import load_artifact
from aomgen.io.review import Review, read_reviews
from aomgen.pipeline.manifest import MANIFEST
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import PROJECT_FILE, STAGES, find_project
from aomgen.results import Results
from aomgen.viewing.draw_list import Draw, DrawList
from aomgen.web.page_server import PageRequest, RequestFields, Response, Route, send_file, send_json

# Positions along each axis of the requested area at which holes are searched: about 9 mm apart for usual ranges.
HOLE_NODES: Final = 40
# Number of holes that are listed for an asset.
HOLES: Final = 3
# Smallest radius of a hole, in mean distances of evenly spread episodes: a regular grid leaves 0.7, about a hundred
# independent positions leave 1.3 to 1.5.
LEAST_HOLE: Final = 2.0


class CoverageRequest(RequestFields):
    """Request of the coverage of one asset by its number, or of all assets."""

    asset: int | None = None


class CoverageRoutes:
    """Routes of the coverage of the run in a folder; the samples are shared with its review."""

    def __init__(self, out: Path, draws: DrawList) -> None:
        self.out, self.draws = out, draws
        self._opened: tuple[int, Results] | None = None

    def list_routes(self) -> dict[str, Route]:
        """Return all routes by method and path."""
        return {
            "GET /coverage": send_file("aomgen.viewing", "coverage.html"),
            "GET /coverage.js": send_file("aomgen.viewing", "coverage.js"),
            "GET /coverage/state": self.send_state,
        }

    def send_state(self, request: PageRequest) -> Response:
        """Send the map with its samples, histograms and holes; empty before the run has fitted its assets."""
        asked, results = request.parse(CoverageRequest), self._open()
        if results is None:
            return send_json({"assets": [], "shapes": [], "draws": [], "histograms": [], "holes": []})
        assets = [fitted.asset.name for fitted in results.fitted_assets]
        chosen = range(len(assets)) if asked.asset is None else [asked.asset]
        if not all(0 <= number < len(assets) for number in chosen):
            raise ValueError(f"there is no asset {asked.asset}")
        draws = [
            draw for draw in self.draws.read() if draw.variation and unit_of(draw.number).asset in chosen
        ]
        return send_json(
            {"assets": assets} | measure_coverage(results, draws, read_reviews(self.out), chosen)
        )

    def _open(self) -> Results | None:
        """Return the results of the run, read again after a new fit; None before the fit, or for a capture."""
        if self.out.is_dir() and not (self.out / PROJECT_FILE).is_file():
            return None
        results = results_of(find_project(self.out), STAGES)
        manifest = results.folders["replacement"] / MANIFEST
        if not manifest.is_file():
            return None
        stamp = manifest.stat().st_mtime_ns
        if self._opened is None or self._opened[0] != stamp:
            self._opened = (stamp, results)
        return self._opened[1]


def measure_coverage(
    results: Results, draws: Sequence[Draw], reviews: dict[int, Review], assets: Sequence[int]
) -> dict[str, Any]:
    """Compute map, samples, histograms and holes of some assets of a run.

    Rejected episodes do not count as coverage.
    """
    params = results.params("episodes", GenerationParams())
    fits, ranges = results.fitted_assets, params.ranges
    maps = [load_artifact(results.folders["episodes"], REACH_MAP.format(number), ReachMap) for number in assets
            if (results.folders["episodes"] / f"{REACH_MAP.format(number)}.json").is_file()]  # fmt: skip
    rows = [
        _describe(draw, place, reviews.get(draw.number, Review()))
        for draw, place in zip(draws, _locate(draws, fits), strict=True)
    ]
    counted = [
        {"variation": draw.variation, "outcome": row["outcome"]}
        for draw, row in zip(draws, rows, strict=True)
    ]
    shapes = [
        {"points": shape.points_world.round(4).tolist(), "color": shape.color, "opacity": shape.opacity}
        for shape in scene_shapes(results.episode_scene, maps)
    ]
    return {
        "shapes": shapes,
        "requested": [outline_request(ranges, fits[number]).round(4).tolist() for number in assets],
        "front_m": LINE_M,
        "draws": rows,
        "histograms": [_histogram(item) for item in distributions(counted, ranges, params.free_cameras)],
        "holes": list(describe_holes(outline_request(ranges, fits[assets[0]]), rows)),
    }


def outline_request(ranges: Ranges, fitted: FittedAsset) -> Array:
    """Compute the corners (N, 2) of the area in which the center of an object is requested, world frame, [m].

    The object has the middle of the range of sizes.
    """
    if ranges.polygon:
        return np.array(ranges.polygon)
    (x0, x1), (y0, y1) = ranges.place_bounds
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    scale = sum(ranges.scale) / 2
    requested = [{"x": x, "y": y, "yaw": 0.0, "frame": ranges.frame, "scale": scale} for x, y in corners]
    return locate_draws(fitted, requested)[:, :2]


def find_holes(area: Array, episodes: Array) -> Iterator[tuple[Array, float]]:
    """Find the largest circles without an episode that are centered in an area; largest first.

    Args:
        area: Corners (N, 2) of the requested area, [m].
        episodes: Positions (E, 2) of the episodes, [m].

    Yields:
        Center (2,) of a circle, [m], and the distance from it to the nearest episode, [m].
    """
    low, high = area.min(0), area.max(0)
    axes = [np.linspace(*bounds, HOLE_NODES) for bounds in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    corners = tuple((float(x), float(y)) for x, y in area)
    nodes = nodes[[inside(corners, node) for node in nodes]]
    if not len(nodes) or not len(episodes):
        return
    pitch = np.sqrt(np.prod(high - low) * len(nodes) / HOLE_NODES**2 / len(episodes))
    distances = np.linalg.norm(nodes[:, None] - episodes, axis=2).min(1)
    for _ in range(HOLES):
        center, radius = nodes[distances.argmax()], float(distances.max())
        if not radius >= LEAST_HOLE * pitch:
            return
        yield center, radius
        # The next circle does not overlap with this one.
        distances = np.minimum(distances, np.linalg.norm(nodes - center, axis=1) - radius)


def describe_holes(area: Array, rows: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Describe the holes in an area, with the number of samples without an episode in each, and these by reason."""
    delivered = np.array([[row["x"], row["y"]] for row in rows if row["outcome"] == "committed"])
    others = [row for row in rows if row["outcome"] != "committed"]
    positions = np.array([[row["x"], row["y"]] for row in others]).reshape(-1, 2)
    for center, radius_m in find_holes(area, delivered):
        inner = np.linalg.norm(positions - center, axis=1) <= radius_m
        near = list(itertools.compress(others, inner))
        yield {
            "x": float(center[0]),
            "y": float(center[1]),
            "radius_m": radius_m,
            "draws": len(near),
            "reasons": dict(Counter(row["reason"] for row in near).most_common()),
        }


def locate_draws(fitted: FittedAsset, variations: Sequence[Mapping[str, Any]]) -> Array:
    """Compute the center of an object's footprint and the direction of its front (N, 4) in stored variations, world frame, [m].

    `reach_map.front_line` computes the same for one variation.
    """
    R, T = fitted.T_world_asset[:3, :3], fitted.T_world_asset
    middle, held = apply(T, np.stack([fitted.middle_asset, fitted.contact_asset]))
    # An object is scaled about its held point.
    scales = np.array([item["scale"] for item in variations])[:, None]
    pivots, front = middle + (1 - scales) * (held - middle), R @ [0.0, -LINE_M, 0.0]
    shifts = np.array([[item["x"], item["y"], 0.0] for item in variations]).reshape(-1, 3)
    frames = np.array([item["frame"] for item in variations])[:, None]
    shifts = np.where(frames == "object", shifts @ R.T, shifts)
    middles = np.where(frames == "polygon", shifts, pivots + shifts)[:, :2]
    yaws = np.array([item["yaw"] for item in variations])
    cos, sin = np.cos(yaws), np.sin(yaws)
    turned = np.stack([cos * front[0] - sin * front[1], sin * front[0] + cos * front[1]], 1)
    return np.concatenate([middles, turned], 1)


def _locate(draws: Sequence[Draw], fits: Sequence[FittedAsset]) -> Array:
    """Apply `locate_draws` to samples of several assets (N, 4)."""
    assets, rows = np.array([unit_of(draw.number).asset for draw in draws]), np.zeros((len(draws), 4))
    for number in np.unique(assets):
        mine = assets == number
        rows[mine] = locate_draws(
            fits[number], [draw.variation for draw in draws if unit_of(draw.number).asset == number]
        )
    return rows.round(4)


def _describe(draw: Draw, place: Array, review: Review) -> dict[str, Any]:
    """Describe a sample on the map; an episode that the review rejects is a rejected sample."""
    rejected = (
        draw.outcome == "committed" and review.decision == "rejected" and review.content == draw.content
    )
    return {
        "number": draw.number,
        "asset": draw.asset,
        "outcome": "rejected" if rejected else draw.outcome,
        "reason": "rejected by a person" if rejected else draw.reason,
        **dict(zip(("x", "y", "dx", "dy"), place.tolist(), strict=True)),
    }


def _histogram(item: Distribution) -> dict[str, Any]:
    return {
        "name": item.name,
        "unit": item.unit,
        "edges": item.edges.tolist(),
        "drawn": item.drawn.tolist(),
        "tried": item.tried.tolist(),
        "delivered": item.delivered.tolist(),
    }
