"""New poses, retargeted, solved for the arm, and verified in physics; attempts are kept one by one. [paper 4.3]"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import FittedAsset, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.core.verdict import Rejection
from aomgen.errors import MalformedFileError
from aomgen.generalization.attempts import AttemptStore, read_attempt, record_of
from aomgen.generalization.episode_planning import PlanParams
from aomgen.generalization.generate import Generated, GenerationParams, generate_episodes
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json
from aomgen.results import Results
from aomgen.robots.robot import RobotModel

INDEX_FILE = "episodes.json"
REJECTED_FILE = "rejected.json"


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

    Attempts that are there from an earlier run are not made again, see `AttemptStore`.

    Raises:
        NotEnoughEpisodesError: Too few variations pass; the attempts stay.
        StorageError: The disk refuses.
    """
    store = AttemptStore(folder)
    generated = generate_episodes(assets, demo, robot, support, params, progress, store)
    store.forget_others()
    names = [record_of(episode.plan.variation) for episode in generated.episodes]
    write_json(folder / INDEX_FILE, {"episodes": names, "skipped": generated.skipped})
    rejected = [
        {"asset": r.asset, "variation": asdict(r.variation), **asdict(r.rejection)}
        for r in generated.rejected
    ]
    write_json(folder / REJECTED_FILE, {"rejected": rejected, "reasons": generated.reasons})
    return generated


def load_generalization(folder: Path, assets: Sequence[FittedAsset]) -> list[VerifiedEpisode]:
    """The verified episodes of a finished stage.

    Args:
        folder: Of the stage.
        assets: The fits that the stage was given.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: An episode names an asset that is not among `assets`, or was rejected.
    """
    fits = {fit.asset.name: fit for fit in assets}
    episodes = []
    for name in read_json(folder / INDEX_FILE)["episodes"]:
        outcome = read_attempt(folder / name, fits)
        if isinstance(outcome, Rejection):
            raise MalformedFileError(
                folder / name, "is no verified episode", "delete the folder and run again"
            )
        episodes.append(outcome)
    return episodes
