"""New poses, retargeted, solved for the arm, and verified in physics. [paper 4.3]

Each attempt is kept as soon as it is made, so that a run that was killed makes none twice:
```
attempts/1-00005.npz     arrays of a verified episode: seed 1, variation 5
attempts/1-00005.json    what it is, or why it was rejected; written last, so an attempt that has it is complete
```
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation, Verdict, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.core.values import Array
from aomgen.episodes.generate import Generated, GenerationParams, Outcome, generate_episodes
from aomgen.episodes.planning import PlanParams
from aomgen.errors import MalformedFileError
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.io.atomic import remove_staging, write_json
from aomgen.results import Results
from aomgen.robots.robot import RobotModel

INDEX_FILE = "episodes.json"
REJECTED_FILE = "rejected.json"
FOLDER: Final = "attempts"
PLAN_ARRAYS: Final = ("T_world_object", "joints", "gripper", "thetas", "phases", "Ts_world_ee")
RUN_ARRAYS: Final = ("joints", "gripper", "thetas", "Ts_world_ee")


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredEpisode:
    """A verified episode without its fitted asset, which the stage before has stored."""

    variation: Variation
    fps: float
    grasp: str
    metrics: Mapping[str, float]
    plan: Mapping[str, Array]
    run: Mapping[str, Array]
    contacts: ContactLog
    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """What came of a variation of an asset: an episode, or a rejection."""

    asset: str
    episode: StoredEpisode | None = None
    rejection: Rejection | None = None


def run(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """New poses of the fitted assets, retargeted, solved for the arm, and verified in physics."""
    scene, project = results.episode_scene, results.project
    defaults = GenerationParams(
        count=project.poses,
        seed=project.seed,
        plan=PlanParams(fps=results.fps),
        cameras=tuple(scene.cameras.values()),
    )
    params = results.params("plans", defaults)
    generated = generate_in(
        folder, results.fitted_assets, results.demonstration, results.robot, scene.support, params, progress
    )
    margins = [episode.verdict.margin for episode in generated.episodes]
    return {
        "verified": len(margins),
        "rejected": len(generated.rejected),
        "smallest_margin": float(min(margins, default=0.0)),
    }


def generate_in(
    folder: Path,
    assets: Sequence[FittedAsset],
    demo: Demonstration,
    robot: RobotModel,
    support: SupportPlane,
    params: GenerationParams,
    progress: Progress,
) -> Generated:
    """Generate episodes (see `generate_episodes`) and write them into `folder`.

    Attempts that are there from an earlier run are not made again: the folder must belong to the same assets,
    demonstration, robot and parameters.

    Raises:
        NotEnoughEpisodesError: Too few variations pass; the attempts stay.
        MalformedFileError, MissingFileError: An earlier attempt cannot be read.
        StorageError: The disk refuses.
    """
    remove_staging(folder / FOLDER)
    asked: set[str] = set()

    def recall(fitted: FittedAsset, variation: Variation, make: Callable[[], Outcome]) -> Outcome:
        asked.add(attempt_name(variation))
        return recall_attempt(folder, fitted, variation, make)

    generated = generate_episodes(assets, demo, robot, support, params, progress, recall)
    for path in (folder / FOLDER).glob("*"):
        if path.stem not in asked:
            path.unlink()
    names = [attempt_name(episode.plan.variation) for episode in generated.episodes]
    write_json(folder / INDEX_FILE, {"episodes": names, "skipped": generated.skipped})
    rejected = [
        {"asset": r.asset, "variation": asdict(r.variation), **asdict(r.rejection)}
        for r in generated.rejected
    ]
    write_json(folder / REJECTED_FILE, {"rejected": rejected, "reasons": generated.reasons})
    return generated


def load_generalization(folder: Path, assets: Sequence[FittedAsset]) -> list[VerifiedEpisode]:
    """The verified episodes of a finished stage, which was given these fits.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: An episode names an asset that is not among `assets`, or was rejected.
    """
    fits = {fit.asset.name: fit for fit in assets}
    episodes = []
    for name in read_json(folder / INDEX_FILE)["episodes"]:
        outcome = read_attempt(folder, name, fits)
        if isinstance(outcome, Rejection):
            path = folder / FOLDER / f"{name}.json"
            raise MalformedFileError(path, "is no verified episode", "delete the folder and run again")
        episodes.append(outcome)
    return episodes


def attempt_name(variation: Variation) -> str:
    """Name of an attempt's files; each asset has a seed of its own."""
    return f"{variation.seed}-{variation.index:05d}"


def recall_attempt(
    folder: Path, fitted: FittedAsset, variation: Variation, make: Callable[[], Outcome]
) -> Outcome:
    """The outcome of an attempt, made and kept if it is not below the stage's folder."""
    name = attempt_name(variation)
    if (folder / FOLDER / f"{name}.json").is_file():
        return read_attempt(folder, name, {fitted.asset.name: fitted})
    outcome = make()
    if isinstance(outcome, Rejection):
        attempt = Attempt(asset=fitted.asset.name, rejection=outcome)
    else:
        attempt = Attempt(asset=fitted.asset.name, episode=_stored(outcome))
    save_artifact(folder / FOLDER, name, attempt)
    return outcome


def read_attempt(folder: Path, name: str, fits: Mapping[str, FittedAsset]) -> Outcome:
    """A stored attempt; `fits` by name of the asset.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: It cannot be read, or names an asset that is not among `fits`.
    """
    attempt, path = load_artifact(folder / FOLDER, name, Attempt), folder / FOLDER / f"{name}.json"
    if attempt.asset not in fits:
        known = ", ".join(sorted(fits))
        raise MalformedFileError(path, f"asset '{attempt.asset}' is unknown", f"known assets: {known}")
    if attempt.rejection is not None:
        return attempt.rejection
    stored = attempt.episode
    try:
        if stored is None:
            raise ValueError("neither episode nor rejection")
        planned: dict[str, Any] = {name: stored.plan[name] for name in PLAN_ARRAYS}
        plan = EpisodePlan(
            variation=stored.variation,
            fitted=fits[attempt.asset],
            fps=stored.fps,
            grasp=stored.grasp,
            metrics=stored.metrics,
            **planned,
        )
        run = {name: stored.run[name] for name in RUN_ARRAYS}
        return VerifiedEpisode(plan=plan, contacts=stored.contacts, verdict=stored.verdict, **run)
    except (KeyError, ValueError) as error:
        raise MalformedFileError(path, f"is no attempt ({error!r})", "delete it and run again") from error


def _stored(episode: VerifiedEpisode) -> StoredEpisode:
    plan = episode.plan
    return StoredEpisode(
        variation=plan.variation,
        fps=plan.fps,
        grasp=plan.grasp,
        metrics=plan.metrics,
        plan={name: getattr(plan, name) for name in PLAN_ARRAYS},
        run={name: getattr(episode, name) for name in RUN_ARRAYS},
        contacts=episode.contacts,
        verdict=episode.verdict,
    )
