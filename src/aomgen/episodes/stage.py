"""Episodes stage: verified and rendered demonstrations of every asset. [paper 4.3.3, 5.2]

One worker makes each episode from start to end, so that no finished episode is lost. The number of parallel
workers is that of the processors, or of Ray.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.progress import Progress
from aomgen.episodes.factory import EpisodeFactory, open_factory
from aomgen.episodes.generate import generate
from aomgen.episodes.grasp_choice import GRASPS_FOLDER
from aomgen.episodes.ledger import (
    ACCOUNTS,
    Account,
    Request,
    Unit,
    distributions,
    read_accounts,
    read_draws,
)
from aomgen.episodes.reach_map import REACH_MAP, ReachMap, draw_map, front_line, map_reach, scene_shapes
from aomgen.episodes.stored_units import RUN_FILE, StoredUnits, share_inputs
from aomgen.episodes.variations import Ranges, scale_fit
from aomgen.errors import ConfigError, NotEnoughEpisodesError
from aomgen.executors import Done, Executor, Opener, Processes
from aomgen.io.artifact import read_json, save_artifact
from aomgen.io.atomic import write_json, write_text
from aomgen.io.episode_folder import EPISODE_FILE, list_committed
from aomgen.ray_cluster import RayCluster
from aomgen.results import Results

# Distributions of the episodes over the requested ranges.
DISTRIBUTIONS_FILE = "distributions.json"
# Number of draws of each asset that are screened: where one in fifty is usable, one is found.
LOOKED_AT: Final = 200
# Number of nodes along each axis of the map of the arm's reach.
WIDE_NODES: Final = 13
PICTURE: Final = "reach_map.svg"
WORDS: Final = {
    "outside_area": "outside the area",
    "off_table": "off the table",
    "blocked": "blocked by an obstacle",
    "out_of_reach": "out of the arm's reach",
}


def run(
    results: Results, folder: Path, progress: Progress, on_done: Callable[[Done], None] = lambda done: None
) -> dict[str, Any]:
    """Make the requested episodes of every asset, or report why there are fewer."""
    factory = EpisodeFactory(results, folder)
    request = Request(
        assets=tuple(fitted.asset.name for fitted in results.fitted_assets),
        episodes=results.project.poses,
        attempts=results.project.poses * factory.params.attempts_per_episode,
    )
    check_ranges(factory, folder)
    for number, found in enumerate(factory.reach_maps):
        save_artifact(folder, REACH_MAP.format(number), found)
    for category in {fitted.asset.category for fitted in results.fitted_assets}:
        progress(0.0, f"usual grasp of the category {category}")
        save_artifact(folder / GRASPS_FOLDER, category, factory.usual_grasp(category))
    # Workers get a copy without cached results.
    opener = partial(open_factory, replace(results), folder)
    store = None
    if results.store:
        store, opener = share_inputs(results, folder)
    executor = open_executor(results, opener, factory.params.timeout_s)
    with StoredUnits(executor, store, folder) if store else executor as units:
        generate(folder, request, units, factory.screen, progress, on_done)
    (folder / RUN_FILE).unlink(missing_ok=True)
    accounts = read_accounts(folder)
    if accounts and not any(account.committed for account in accounts):
        raise NotEnoughEpisodesError(
            "episodes",
            " ".join(map(account_sentence, accounts)),
            "choose other ranges of poses, or another asset",
        )
    draws = read_draws(folder)
    write_json(
        folder / DISTRIBUTIONS_FILE,
        {item.name: asdict(item) for item in distributions(draws, factory.params.ranges, factory.place.free)},
    )
    margins = [read_json(path / EPISODE_FILE)["verdict"]["margin"] for path in list_committed(folder)]
    return {
        "episodes": sum(account.committed for account in accounts),
        "short": sum(account.rejected for account in accounts),
        "rejected": sum(account.attempts - account.committed for account in accounts),
        "skipped": sum(draw["outcome"] == "skipped" for draw in draws),
        "smallest_margin": float(min(margins, default=0.0)),
        "cameras": ", ".join([*factory.place.cameras, *["free"] * factory.place.free]),
        ACCOUNTS: [asdict(account) for account in accounts],
        "warnings": [account_sentence(account) for account in accounts if account.rejected],
    }


def open_executor(results: Results, opener: Opener, timeout_s: float) -> Executor:
    """Open workers as requested for the run.

    Raises:
        BackendError: Ray is not available.
    """
    if results.ray:
        return RayCluster(opener, results.ray, timeout_s)
    return Processes(opener, results.workers, timeout_s)


def account_sentence(account: Account) -> str:
    """Describe the outcome of an asset's request in one sentence."""
    return (
        f"asset {account.asset}: {account.committed} of {account.requested} episodes from {account.attempts} planned samples "
        f"({account.why or 'no sample'})"
    )


def check_ranges(factory: EpisodeFactory, folder: Path) -> None:
    """Screen the first draws of the assets until one can be used; where none can, write a map into `folder`.

    An asset without a usable draw is reported in its account when the others are made.

    Raises:
        ConfigError: No draw is usable; states the location of the draws, the table and the reach.
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
    rejection = factory.place.find_obstruction(variation, scale_fit(fitted, variation.scale))
    if rejection is not None:
        return rejection.reason
    return "" if found.may_reach(variation) else "out_of_reach"


def _refusal(
    factory: EpisodeFactory, fitted: FittedAsset, reasons: dict[Variation, str], picture: Path
) -> ConfigError:
    """Make the error about the ranges of an asset; the map at `picture` illustrates it."""
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
        f"the arm can hold its handle at {_extent(reached)}"
        if len(reached)
        else "the arm cannot hold its handle anywhere"
    )
    table = np.stack([scene.support.low_xy, scene.support.high_xy])
    return ConfigError(
        "episodes.ranges",
        f"no feasible pose for {fitted.asset.name}: of {len(reasons)} samples, at {_extent(places)}, {counted}",
        f"{reach}, the free table is {_extent(table)}: {picture} shows both",
    )


def _extent(points: np.ndarray) -> str:
    """Format the bounds of points (N, 2)."""
    (low_x, low_y), (high_x, high_y) = points.min(0), points.max(0)
    return f"x {low_x:.2f} to {high_x:.2f} m, y {low_y:.2f} to {high_y:.2f} m"
