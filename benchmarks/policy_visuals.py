"""Episodes rendered again by MuJoCo's renderer: training data of a policy without splats."""

from functools import cache, partial
from pathlib import Path

from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import unit_of
from aomgen.evaluation.suite import open_results
from aomgen.evaluation.views import SimulatorViews
from aomgen.io.episode_folder import commit_episode, list_committed, read_episode
from aomgen.io.video import encode_video
from benchmarks.replay_runs import start_workers


def redraw(run: Path, home: Path) -> list[Path]:
    """Write a run's episodes with the simulator's images to folders in `home`; existing ones are kept."""
    committed = list_committed(open_results(run).folders["episodes"])
    missing = [path for path in committed if not (home / path.name).is_dir()]
    with start_workers() as pool:
        list(pool.map(partial(_redraw, run, home), missing))
    return list_committed(home)


def _redraw(run: Path, home: Path, source: Path) -> None:
    episode, factory, unit = read_episode(source).episode, _factory(run), unit_of(source.name)
    opened, variation = factory.asset(unit.asset), factory.variation(unit)
    views = SimulatorViews(factory, opened, opened.sized(variation.scale)[0], variation)
    drawn = [views.draw(episode.at([time_s])) for time_s in episode.times_s]
    videos = {name: encode_video([images[name] for images in drawn], episode.fps) for name in episode.cameras}
    commit_episode(home, episode, videos)


@cache
def _factory(run: Path) -> EpisodeFactory:
    results = open_results(run)
    return EpisodeFactory(results, results.folders["episodes"])
