"""Generate verified episodes and keep them: one file each, rejections beside them."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.core.verdict import SettingOutcome, Verdict
from aomgen.errors import MalformedFileError
from aomgen.generalization.generate import Generated, GenerationParams, generate_episodes
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.jsonfile import read_json
from aomgen.physics.robot import RobotModel

INDEX_FILE = "episodes.json"
REJECTED_FILE = "rejected.json"
PLAN_ARRAYS = ("T_world_object", "joints", "gripper", "thetas", "phases", "Ts_world_ee")
RUN_ARRAYS = ("joints", "gripper", "thetas", "Ts_world_ee")
CONTACT_ARRAYS = ("frames", "fingers", "points_world", "normals_world", "forces")


def run_generalization(
    assets: Sequence[FittedAsset],
    demo: Demonstration,
    robot: RobotModel,
    support: SupportPlane,
    params: GenerationParams,
    folder: Path,
    progress: Progress,
) -> Generated:
    """Generate episodes (see `generate_episodes`) and write them into `folder`.

    Raises:
        NotEnoughEpisodesError: Too few variations pass.
        StorageError: The disk refuses.
    """
    generated = generate_episodes(assets, demo, robot, support, params, progress)
    rows = []
    for number, episode in enumerate(generated.episodes):
        name = f"{number:05d}.npz"
        write_bytes(folder / name, npz_bytes(_arrays(episode)))
        plan = episode.plan
        rows.append(
            {
                "file": name,
                "asset": plan.fitted.asset.name,
                "variation": asdict(plan.variation),
                "fps": plan.fps,
                "grasp": plan.grasp,
                "metrics": dict(plan.metrics),
                "verdict": episode.verdict.as_json(),
            }
        )
    write_json(folder / INDEX_FILE, {"episodes": rows, "skipped": generated.skipped})
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
        MalformedFileError: An episode names an asset that is not among `assets`.
    """
    fits = {fit.asset.name: fit for fit in assets}
    episodes = []
    for row in read_json(folder / INDEX_FILE)["episodes"]:
        if row["asset"] not in fits:
            known = ", ".join(sorted(fits))
            raise MalformedFileError(
                folder / INDEX_FILE, f"asset '{row['asset']}' is unknown", f"known assets: {known}"
            )
        episodes.append(_episode(row, read_npz(folder / row["file"]), fits[row["asset"]]))
    return episodes


def _arrays(episode: VerifiedEpisode) -> dict[str, np.ndarray]:
    return {
        **{f"plan_{name}": getattr(episode.plan, name) for name in PLAN_ARRAYS},
        **{f"run_{name}": getattr(episode, name) for name in RUN_ARRAYS},
        **{f"contact_{name}": getattr(episode.contacts, name) for name in CONTACT_ARRAYS},
    }


def _episode(row: dict, arrays: dict[str, np.ndarray], fitted: FittedAsset) -> VerifiedEpisode:
    stored = row["verdict"]
    verdict = Verdict(
        target_theta=stored["target_theta"],
        outcomes=tuple(SettingOutcome(**outcome) for outcome in stored["dynamic"]),
        kinematic=stored["kinematic"],
        bolted=stored["bolted"],
    )
    plan = EpisodePlan(
        variation=Variation(**row["variation"]),
        fitted=fitted,
        fps=row["fps"],
        grasp=row["grasp"],
        metrics=row["metrics"],
        **{name: arrays[f"plan_{name}"] for name in PLAN_ARRAYS},
    )
    contacts = ContactLog(**{name: arrays[f"contact_{name}"] for name in CONTACT_ARRAYS})
    return VerifiedEpisode(
        plan=plan,
        contacts=contacts,
        verdict=verdict,
        **{name: arrays[f"run_{name}"] for name in RUN_ARRAYS},
    )
