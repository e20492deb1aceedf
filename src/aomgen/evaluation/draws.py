"""Sampling of the trials of a suite: uniform and independent over the ranges of the project, with a verified plan."""

import math
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.plan import Rejection, Variation, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.datasets.features import ActionSpace
from aomgen.datasets.selection import require_smaller
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.variations import draw_independently
from aomgen.errors import ConfigError, NotEnoughEpisodesError, suggest
from aomgen.evaluation.suite import (
    TRIAL_S,
    Suite,
    Trial,
    fixed_cameras,
    nearest_pose,
    require_apart,
    require_json,
    training_poses,
    twin_digest,
    write_suite,
)
from aomgen.executors import Processes
from aomgen.io.atomic import remove_folder
from aomgen.results import Results
from aomgen.saved_units import SavedUnits
from aomgen.simulation.settings import draw_settings

# Largest number of samples for a trial; if 1 % of them are feasible, one is found almost certainly.
MAX_TRIAL_DRAWS: Final = 500
# Number of samples that the planner or the simulation refuses until other physical parameters are sampled: with some, an object
# cannot be opened, for example if it is heavy, latched and slippery.
REFUSED_DRAWS: Final = 20
# Time limit of a trial as a multiple of the longest plan, because policies are slower than plans.
PATIENCE: Final = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteRequest:
    """Settings of a suite.

    Attributes:
        trials: Number of trials; they are distributed evenly over the assets, in turn.
        seed: Random seed.
        action_space: Action space of the suite.
        size: Size of the images, reduced by area averaging, [px]; None selects that of the run.
        cameras: Names of the cameras; empty selects all cameras of the run.
    """

    trials: int = 200
    seed: int = 1
    action_space: ActionSpace = "joint"
    size: tuple[int, int] | None = None
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnTrial:
    """A trial, the number of frames of its plan, and the number of samples skipped before it, by reason."""

    trial: Trial
    frames: int
    redrawn: dict[str, int]


def make_suite(
    results: Results, path: Path, request: SuiteRequest, workers: int, progress: Progress
) -> Suite:
    """Sample a suite and write it; the trials of an interrupted call are kept.

    Raises:
        ConfigError: The seed is that of the run, a camera is unknown, or the run renders smaller images.
        NotEnoughEpisodesError: Almost no sample passes.
        AomgenError: The run has not finished the required stages.
    """
    require_json(path)
    cameras = _chosen_cameras(results, request.cameras)
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    for size in sizes.values():
        require_smaller(request.size or size, size, "what the run draws")
    if request.seed == results.project.seed:
        raise ConfigError("--seed", f"{request.seed} is the seed of the run", "choose another one")
    twin = twin_digest(results)
    identity = {
        "twin": twin,
        **asdict(request),
        "params": asdict(results.params("episodes", GenerationParams())),
    }
    parts = SavedUnits(path.with_name(f"{path.stem}.parts"), identity, DrawnTrial)
    # A copy without cached results.
    opener = partial(_open_drawing, replace(results), request)
    drawn = parts.make(range(request.trials), Processes(opener, workers, TRIAL_S), progress)
    suite = Suite(
        run=os.path.relpath(results.out.resolve(), path.resolve().parent),
        twin=twin,
        task=results.recorded.instruction,
        assets=tuple(fitted.asset.name for fitted in results.fitted_assets),
        joint_names=results.robot.joint_names,
        fps=round(results.fps),
        action_space=request.action_space,
        cameras={name: camera.resize(*(request.size or sizes[name])) for name, camera in cameras.items()},
        drawn_size=sizes[next(iter(fixed_cameras(cameras, results.robot)))],
        max_frames=math.ceil(PATIENCE * max(item.frames for item in drawn)),
        seed=request.seed,
        trials=tuple(item.trial for item in drawn),
        redrawn=dict(sum((Counter(item.redrawn) for item in drawn), Counter[str]()).most_common()),
        nearest=None,
    )
    suite = replace(suite, nearest=require_apart(suite, results)).seal()
    write_suite(path, suite)
    remove_folder(parts.folder)
    return suite


def _chosen_cameras(results: Results, wanted: tuple[str, ...]) -> dict[str, Camera]:
    fixed, params = results.episode_scene.cameras, results.params("episodes", GenerationParams())
    carried = {name: camera for name, (_, camera) in results.robot.cameras.items()}
    known = {**fixed, **carried}
    usual = (*(params.cameras or fixed), *(carried if params.images.robot_cameras else ()))
    for name in wanted or usual:
        if name not in known:
            raise ConfigError("--camera", f"'{name}' is not a camera of this run", suggest(name, known))
    chosen = {name: known[name] for name in wanted or usual}
    if not fixed_cameras(chosen, results.robot):
        raise ConfigError(
            "--camera", "selects only cameras on the robot", f"name one of {', '.join(fixed)} as well"
        )
    return chosen


def _open_drawing(results: Results, request: SuiteRequest) -> Callable[[int], DrawnTrial]:
    cameras = fixed_cameras(_chosen_cameras(results, request.cameras), results.robot)
    return partial(draw_trial, EpisodeFactory(results, results.folders["episodes"], cameras), request)


def draw_trial(factory: EpisodeFactory, request: SuiteRequest, number: int) -> DrawnTrial:
    """Sample a trial of a suite; each has a separate sequence of random numbers.

    Raises:
        NotEnoughEpisodesError: None of its samples passes.
    """
    asset = number * len(factory.results.fitted_assets) // request.trials
    rng = np.random.default_rng([request.seed, number])
    training = training_poses(factory.results)
    redrawn, refused = Counter[str](), 0
    while redrawn.total() < MAX_TRIAL_DRAWS:
        # The index determines the physical parameters.
        index = number + request.trials * (refused // REFUSED_DRAWS)
        variation = draw_independently(rng, request.seed, index, factory.params.ranges)
        unusable = _screen_variation(factory, asset, variation, training)
        made = unusable or factory.certify(factory.asset(asset), variation)
        if isinstance(made, VerifiedEpisode):
            plan, settings = made.plan, draw_settings(made.plan.fitted.asset, request.seed, index)
            trial = Trial(
                asset=asset,
                variation=variation,
                setting=settings[int(rng.integers(len(settings)))],
                joints=plan.joints[0],
                gripper=float(plan.gripper[0]),
            )
            return DrawnTrial(trial=trial, frames=len(plan), redrawn=dict(redrawn))
        redrawn[made.reason] += 1
        refused += unusable is None
    raise NotEnoughEpisodesError(
        "suite",
        f"none of {MAX_TRIAL_DRAWS} draws for trial {number} passes ({redrawn.most_common()})",
        "choose other ranges in the project",
    )


def _screen_variation(
    factory: EpisodeFactory, asset: int, variation: Variation, training: dict
) -> Rejection | None:
    """Return the reason why a sample is skipped without planning, if any."""
    fitted, _ = factory.asset(asset).sized(variation.scale)
    found = nearest_pose(variation.place_at(fitted), training)
    if found is not None and not found[0].apart >= 1:
        return Rejection(reason="in_training", detail=f"has the same pose as in episode {found[1]}")
    return factory.place.screen(variation, fitted)
