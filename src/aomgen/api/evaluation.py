"""Policies, evaluated in closed loop in a run's twin."""

import re
from pathlib import Path
from typing import Any

from aomgen.api.arguments import require_count, require_name
from aomgen.api.run import Run
from aomgen.core.progress import Progress, silent
from aomgen.datasets.features import ACTION_SPACES, ActionSpace
from aomgen.evaluation.draws import SuiteRequest, make_suite
from aomgen.evaluation.evaluate import EvaluationRequest
from aomgen.evaluation.evaluate import evaluate as evaluate_policy
from aomgen.evaluation.views import VISUALS, Visuals

# Below a run's folder: suites and rollouts.
EVALUATION_FOLDER = "evaluation"


def evaluate(
    run: Run,
    policy: str,
    *,
    trials: int = 200,
    seed: int = 1,
    actions: ActionSpace = "joint",
    visuals: Visuals = "splat",
    size: tuple[int, int] | None = None,
    out: str | Path | None = None,
    workers: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Let a policy try sampled poses of a run's assets in simulation, and count how often it opens them.

    Every trial has a plan that passes verification, so that it can be solved. An interrupted call continues.

    Args:
        run: A run that has finished stage "replacement".
        policy: "oracle_replay", "nearest_replay", "lerobot:FOLDER", "openpi://HOST:PORT" or "openvla://HOST:PORT".
        trials: Number of trials; the assets share them.
        seed: Seed of the trials; not that of the run.
        actions: "joint", "ee_absolute" or "ee_delta".
        visuals: "splat", or "simulator" for MuJoCo's renderer.
        size: Width and height of the images that the policy gets, [px]; as the run renders them when None.
        out: Folder of suite and rollouts; below the run's folder when None.
        workers: Processes; 0 for one per processor.
        progress: Receives the share done and a text.

    Returns:
        `success_rate`, `interval_95` (Wilson), `successes`, `trials`, `failures` by reason, and all `rollouts`.

    Raises:
        UnknownNameError: An unknown policy, action space or renderer; lists the known ones.
        NotEnoughEpisodesError: Hardly any sampled pose can be solved.

    Example:
        >>> run = ag.Run.open("out")
        >>> figures = ag.evaluate(run, "oracle_replay", trials=1, size=(64, 48), out="evaluation", workers=1)
        >>> figures["successes"]
        1
    """
    run.require_stage("replacement")
    require_name("actions", actions, ACTION_SPACES)
    require_name("visuals", visuals, VISUALS)
    folder = run.folder / EVALUATION_FOLDER if out is None else Path(out).resolve()
    count = require_count("workers", workers, 0) or run.results.workers
    request = SuiteRequest(
        trials=require_count("trials", trials),
        seed=seed,
        action_space=actions,
        size=size,
    )
    name = "-".join([str(trials), str(seed), actions, *([f"{size[0]}x{size[1]}"] if size else [])])
    suite = make_suite(run.results, folder / f"{name}.json", request, count, progress)
    judged = EvaluationRequest(policy=policy, visuals=visuals)
    rollouts = folder / "-".join([name, re.sub(r"\W+", "-", policy), visuals])
    return evaluate_policy(suite, run.results, rollouts, judged, count, progress)
