"""Roll out a policy in all trials of a suite, in parallel processes, and summarize the results."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from aomgen.core.keypoints import KEYPOINTS
from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze_arrays
from aomgen.datasets.features import ActionSpace
from aomgen.evaluation.finder_errors import summarize_points
from aomgen.evaluation.policies import Policy, open_policy
from aomgen.evaluation.rollout import World
from aomgen.evaluation.suite import TRIAL_S, Suite, require_apart
from aomgen.evaluation.views import Visuals
from aomgen.executors import Processes
from aomgen.io.atomic import write_bytes
from aomgen.io.video import encode_video
from aomgen.results import Results
from aomgen.saved_units import SavedUnits

# Number of failures that are kept as videos.
FILMED: Final = 10
ROLLOUTS_FOLDER, VIDEOS_FOLDER = "rollouts", "failures"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationRequest:
    """The evaluated policy and its inputs.

    Attributes:
        policy: See `policies.open_policy`.
        action_space: Action space of the policy; None selects that of the suite.
        visuals: Renderer of its images.
    """

    policy: str
    action_space: ActionSpace | None = None
    visuals: Visuals = "splat"


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutRecord:
    """Result of one trial.

    Attributes:
        trial: Number of the trial.
        fail_reason: Reason of a failure; empty after a success.
        opening_share: Final travel of the object's joint divided by the planned travel.
        frames: Number F of executed actions.
        touched_obstacle: Whether the robot touched an obstacle, which is anything but object and table.
        opening_shares: Opening share after each action (F,).
        ee_world: Position of the end effector after each action (F, 3), world frame, [m].
        finder_mm: Errors (L, 5) of the keypoints that the policy located in each of its L observations with images;
            without rows if it locates none.
    """

    trial: int
    fail_reason: str
    opening_share: float
    frames: int
    touched_obstacle: bool
    opening_shares: Annotated[Array, "F"]
    ee_world: Annotated[Array, "F 3"]
    finder_mm: Annotated[Array, "L 5"] = field(default_factory=lambda: np.zeros((0, len(KEYPOINTS))))

    __post_init__ = freeze_arrays

    @property
    def figures(self) -> dict[str, Any]:
        """Return the values of the trial except those of single frames."""
        names = ("trial", "fail_reason", "opening_share", "frames", "touched_obstacle")
        return {name: getattr(self, name) for name in names}


def evaluate(
    suite: Suite, results: Results, out: Path, request: EvaluationRequest, workers: int, progress: Progress
) -> dict[str, Any]:
    """Evaluate a policy; stored rollouts are reused.

    Args:
        suite, results: The trials, and the run to which they belong.
        out: Receives a file for each rollout, and videos of some failures.
        request: Policy and its settings.
        workers: Number of processes.
        progress: Called after every rollout.

    Returns:
        `policy`, `suite` and `twin` (digests), `action_space`, `visuals`, `trials`, `successes`, `success_rate`,
        `interval_95` (Wilson's), `failures` by reason, `touched_obstacle` (number of trials), `redrawn` (skipped samples by reason), `nearest_mm` and
        `nearest_deg` (smallest distance between a trial and a training episode), all `rollouts`, and `finder_error_mm`
        of each keypoint if the policy locates keypoints.

    Raises:
        ConfigError: The policy is unknown, or a trial has the object pose of a training episode.
        AomgenError: Any error of the policy.
    """
    nearest = require_apart(suite, results)
    identity = {"suite": suite.digest, **asdict(request)}
    suite = replace(suite, action_space=request.action_space or suite.action_space)
    # A copy without cached results.
    opener = partial(_open_rollouts, suite, replace(results), request)
    # A policy that cannot be opened is refused before processes are started.
    identity["weights"] = open_policy(request.policy, World(suite, results, request.visuals)).digest
    parts = SavedUnits(out / ROLLOUTS_FOLDER, identity, RolloutRecord)
    rows = parts.make(range(len(suite.trials)), Processes(opener, workers, TRIAL_S), progress)
    failed = [row.trial for row in rows if row.fail_reason][:FILMED]
    filming = Processes(partial(opener, film=out / VIDEOS_FOLDER), workers, TRIAL_S)
    SavedUnits(out / VIDEOS_FOLDER, identity, RolloutRecord).make(failed, filming, progress)
    successes = len(rows) - sum(bool(row.fail_reason) for row in rows)
    finder_mm = np.concatenate([row.finder_mm for row in rows])
    return {
        **({"finder_error_mm": summarize_points(finder_mm)} if len(finder_mm) else {}),
        "policy": request.policy,
        "suite": suite.digest,
        "twin": suite.twin,
        "action_space": suite.action_space,
        "visuals": request.visuals,
        "trials": len(rows),
        "successes": successes,
        "success_rate": successes / len(rows),
        "interval_95": interval_95(successes, len(rows)),
        "failures": dict(Counter(row.fail_reason for row in rows if row.fail_reason).most_common()),
        "touched_obstacle": sum(row.touched_obstacle for row in rows),
        "redrawn": dict(suite.redrawn),
        "nearest_mm": nearest and nearest.mm,
        "nearest_deg": nearest and nearest.deg,
        "rollouts": [row.figures for row in rows],
    }


def interval_95(successes: int, trials: int) -> list[float]:
    """Compute Wilson's 95 % interval of a success rate."""
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return [float(interval.low), float(interval.high)]


def _open_rollouts(
    suite: Suite, results: Results, request: EvaluationRequest, film: Path | None = None
) -> Callable[[int], RolloutRecord]:
    world = World(suite, results, request.visuals)
    return partial(roll_out, world, open_policy(request.policy, world), film=film)


def roll_out(world: World, policy: Policy, number: int, film: Path | None = None) -> RolloutRecord:
    """Run a policy in one trial until it ends; its video is written to the folder `film` if one is given."""
    rollout, frames = world.rollout(number), list[NDArray[np.uint8]]()
    openings, joints, finder_mm = list[float](), list[Array](), list[Array]()
    policy.reset(rollout)
    while rollout.fail_reason is None:
        looks = policy.looks(rollout.frame)
        observation = rollout.observation(pixels=film is not None or looks)
        if film is not None:
            frames.append(place_side_by_side(list(observation["pixels"].values())))
        action = np.asarray(policy.act(observation), np.float64)
        if looks and policy.points_world is not None:
            errors = policy.points_world - rollout.locate_keypoints()
            finder_mm.append(1000 * np.linalg.norm(errors, axis=1))
        rollout.step(action)
        openings.append(rollout.opening_share)
        joints.append(rollout.reached.joints[0])
    if film is not None:
        write_bytes(film / f"{number:04d}.mp4", encode_video(np.stack(frames), world.suite.fps))
    return RolloutRecord(
        trial=number,
        fail_reason=rollout.fail_reason,
        opening_share=rollout.opening_share,
        frames=rollout.frame,
        touched_obstacle=rollout.touched_obstacle,
        opening_shares=np.array(openings),
        ee_world=world.factory.results.robot.ee_poses(np.stack(joints))[:, :3, 3],
        finder_mm=np.reshape(finder_mm, (-1, len(KEYPOINTS))),
    )


def place_side_by_side(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Join images (H, W, 3) of any sizes into one, aligned at their upper edges on black."""
    height = max(len(image) for image in images)
    return np.concatenate([np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in images], 1)
