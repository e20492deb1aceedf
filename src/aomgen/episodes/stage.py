"""Verified demonstrations of every asset: drawn, planned, simulated, rendered and committed one by one. [paper 4.3.3, 5.2]

Each is made from start to end by one worker, so that nothing that was made is lost, and as many work at the same time
as there are processors, or Ray has.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from aomgen.core.progress import Progress
from aomgen.episodes.distributions import distributions
from aomgen.episodes.factory import EpisodeFactory, open_factory, open_grasping
from aomgen.episodes.generate import generate
from aomgen.episodes.grasp_choice import GRASPS_FOLDER, WorkingGrasps
from aomgen.episodes.ledger import Account, Request, read_accounts, read_draws
from aomgen.episodes.range_check import check_ranges
from aomgen.episodes.reach_map import REACH_MAP
from aomgen.errors import NotEnoughEpisodesError
from aomgen.executors import Done, Executor, Opener, Processes, RayCluster
from aomgen.io.artifact import read_json, save_artifact
from aomgen.io.atomic import write_json
from aomgen.io.episode_folder import EPISODE_FILE, list_committed
from aomgen.results import Results
from aomgen.saved_units import SavedUnits

# How the episodes are spread over what was asked for.
DISTRIBUTIONS_FILE = "distributions.json"


def run(
    results: Results, folder: Path, progress: Progress, on_done: Callable[[Done], None] = lambda done: None
) -> dict[str, Any]:
    """As many episodes of every asset as the project asks for, or fewer and why."""
    factory = EpisodeFactory(results, folder)
    request = Request(
        assets=tuple(fitted.asset.name for fitted in results.fitted_assets),
        episodes=results.project.poses,
        attempts=results.project.poses * factory.params.attempts_per_episode,
    )
    check_ranges(factory, folder)
    for number, found in enumerate(factory.reach_maps):
        save_artifact(folder, REACH_MAP.format(number), found)
    # A copy without what has been read.
    opened = (replace(results), folder)
    SavedUnits(folder / GRASPS_FOLDER, {}, WorkingGrasps).make(
        range(len(request.assets)),
        open_executor(results, partial(open_grasping, *opened), factory.params.timeout_s),
        lambda share, text: progress(0.0, f"grasps of {text} assets tried"),
    )
    for category in {fitted.asset.category for fitted in results.fitted_assets}:
        save_artifact(folder / GRASPS_FOLDER, category, factory.usual_grasp(category))
    with open_executor(results, partial(open_factory, *opened), factory.params.timeout_s) as executor:
        generate(folder, request, executor, factory.screen, progress, on_done)
    accounts = read_accounts(folder)
    if accounts and not any(account.committed for account in accounts):
        raise NotEnoughEpisodesError(
            "episodes",
            " ".join(map(account_sentence, accounts)),
            "ask for other poses, or choose another asset",
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
        "warnings": [account_sentence(account) for account in accounts if account.rejected],
    }


def open_executor(results: Results, opener: Opener, timeout_s: float) -> Executor:
    """Workers as the run was asked for.

    Raises:
        BackendError: There is no Ray.
    """
    if results.ray:
        return RayCluster(opener, results.ray, timeout_s)
    return Processes(opener, results.workers, timeout_s)


def account_sentence(account: Account) -> str:
    """What came of an asset's request, in one sentence."""
    return (
        f"asset {account.asset}: {account.committed} of {account.requested} episodes after {account.attempts} attempts "
        f"({account.why or 'none tried'})"
    )
