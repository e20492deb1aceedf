"""`python -m benchmarks environment`: verdicts, images and speed of the twin in closed loop."""

import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.utils.env_checker import check_env

from aomgen.datasets.features import ACTION_SPACES
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.ledger import unit_of
from aomgen.episodes.render import render_episode
from aomgen.evaluation.draws import SuiteRequest, make_suite
from aomgen.evaluation.environment import OpenEnv
from aomgen.evaluation.evaluate import EvaluationRequest, evaluate
from aomgen.evaluation.policies import ORACLE, OracleReplay
from aomgen.evaluation.rollout import World
from aomgen.evaluation.suite import open_results, open_suite
from aomgen.evaluation.views import SplatViews
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.results import Results

# Image sizes that steps are timed at, two cameras each, [px].
SIZES: Final = ((320, 240), (128, 128))
# Number of episodes of each asset whose images are compared, and frames of each of them.
COMPARED_EPISODES, COMPARED_FRAMES = 3, 10
# Trials whose resets and steps are timed, after one that opens all files.
TIMED_TRIALS: Final = 3
SEED: Final = 7
# Value reported for equal images, whose signal-to-noise ratio is infinite, [dB].
EQUAL_DB: Final = 100.0


def run_environment(
    run: Path, folder: Path, trials: int, workers: int, notify: Callable[[str], None]
) -> dict[str, Any]:
    """Measure the environment of a run that has committed episodes.

    Args:
        run: Folder of the run.
        folder: Folder of suite and rollouts; a killed benchmark continues from it.
        trials: Number of trials of each action space.
        workers: Number of processes.
        notify: Receives the progress.

    Returns:
        `oracle_replay` and `nearest_replay` by action space, `pixels_psnr` (the worst frame, [dB]), `step_cpu_ms` by
        image size and `reset_s` (medians of CPU time), `redrawn`, `nearest_mm`, `nearest_deg`, and `check_env`.
    """
    path = folder / "suite.json"
    if not path.is_file():
        make_suite(
            open_results(run),
            path,
            SuiteRequest(trials=trials, seed=SEED),
            workers,
            lambda share, text: notify(text),
        )
    opened, figures = open_suite(path), dict[str, Any]({ORACLE: {}})
    for space in ACTION_SPACES:
        request = EvaluationRequest(policy=ORACLE, action_space=space)
        found = evaluate(*opened, folder / space, request, workers, lambda share, text: notify(text))
        figures[ORACLE][space] = {
            name: found[name] for name in ("success_rate", "interval_95", "trials", "failures")
        }
        figures |= {name: found[name] for name in ("redrawn", "nearest_mm", "nearest_deg")}
    figures["pixels_psnr"] = worst_psnr(open_results(run))
    world = World(*opened)
    timed = {f"{width}x{height}": time_steps(resized(world, (width, height))) for width, height in SIZES}
    figures["step_cpu_ms"] = {name: step_ms for name, (step_ms, _) in timed.items()}
    figures["reset_s"] = {name: reset_s for name, (_, reset_s) in timed.items()}
    return figures | {"check_env": passes_check(world)}


def resized(world: World, size: tuple[int, int]) -> World:
    """Change the image size of the trials."""
    cameras = {name: camera.resize(*size) for name, camera in world.suite.cameras.items()}
    return World(replace(world.suite, cameras=cameras, drawn_size=size), world.factory.results)


def worst_psnr(results: Results) -> float:
    """Compute the least PSNR of the environment's images against an episode's unencoded ones, [dB]."""
    folder, worst = results.folders["episodes"], EQUAL_DB
    factory = EpisodeFactory(results, folder)
    for asset in range(len(results.fitted_assets)):
        episodes = [path for path in list_committed(folder) if unit_of(path.name).asset == asset]
        for path in episodes[:COMPARED_EPISODES]:
            worst = min(worst, *_psnrs(factory, path))
    return worst


def _psnrs(factory: EpisodeFactory, path: Path) -> list[float]:
    episode, unit = read_episode(path).episode, unit_of(path.name)
    opened, variation = factory.asset(unit.asset), factory.variation(unit)
    fitted, _ = opened.sized(variation.scale)
    cameras = factory.place.cameras
    twin, layers, soft = opened.show_variation(variation, cameras)
    scene, robot = factory.results.episode_scene, factory.results.robot
    carried = robot.camera_paths(episode.joints, episode.gripper)
    paths = {name: path for name, path in carried.items() if name in episode.cameras}
    drawn = render_episode(twin, robot, episode, layers, scene.T_world_plane, 1, soft=soft, paths=paths)
    views, found = SplatViews(factory, opened, fitted, variation, tuple(paths)), []
    for t in np.linspace(0, len(episode) - 1, COMPARED_FRAMES).astype(int).tolist():
        for name, image in views.draw(episode.at(episode.times_s[[t]])).items():
            error = np.mean((image.astype(np.float64) - drawn[name].images_srgb[t]) ** 2)
            found.append(float(10 * np.log10(255**2 / error)) if error else EQUAL_DB)
    return found


def time_steps(world: World) -> tuple[float, float]:
    """Measure the median CPU time of a step, [ms], and of a reset, [s], with images, on one thread."""
    env = OpenEnv(world)
    policy = OracleReplay(world)
    steps, resets = [], []
    for trial in (0, *range(TIMED_TRIALS)):
        begin = time.process_time()
        observation, _ = env.reset(options={"trial": trial})
        resets.append(time.process_time() - begin)
        policy.reset(world.rollout(trial))
        over = False
        while not over:
            action = policy.act(observation)
            begin = time.process_time()
            observation, _, ended, late, _ = env.step(action.astype(np.float32))
            steps.append(1000 * (time.process_time() - begin))
            over = ended or late
    return float(np.median(steps)), float(np.median(resets[1:]))


def passes_check(world: World) -> bool:
    """Run Gymnasium's own check; raises the errors that it finds."""
    env = OpenEnv(resized(world, (64, 48)))
    with warnings.catch_warnings():
        # Joints and poses have no own bounds.
        warnings.filterwarnings("ignore", message=".*(infinity|Box action space|alternative render modes).*")
        check_env(env)
    return True
