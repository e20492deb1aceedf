"""Attempts on disk: each is kept as soon as it is made, so that a run that was killed makes none twice.

```
attempts/1-00005.npz     arrays of a verified episode: seed 1, variation 5
attempts/1-00005.json    what it is, or why it was rejected; written last, so an attempt that has it is complete
```
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.core.verdict import Rejection, SettingOutcome, Verdict
from aomgen.errors import MalformedFileError
from aomgen.generalization.generate import Outcome
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import remove_staging, write_bytes, write_json
from aomgen.io.jsonfile import read_json

FOLDER: Final = "attempts"
PLAN_ARRAYS: Final = ("T_world_object", "joints", "gripper", "thetas", "phases", "Ts_world_ee")
RUN_ARRAYS: Final = ("joints", "gripper", "thetas", "Ts_world_ee")
CONTACT_ARRAYS: Final = ("frames", "fingers", "points_world", "normals_world", "forces")


class AttemptStore:
    """Remembers attempts; a `generate.Recall`.

    Args:
        folder: Of the stage; what dead processes left half-written there is deleted. It must belong
            to the same assets, demonstration, robot and parameters: an attempt that is there is taken as it is.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._asked: set[Path] = set()
        remove_staging(folder / FOLDER)

    def __call__(self, fitted: FittedAsset, variation: Variation, make: Callable[[], Outcome]) -> Outcome:
        """The outcome of an attempt, made and kept if it is not there.

        Raises:
            MalformedFileError, MissingFileError: What is there cannot be read.
            StorageError: The disk refuses.
        """
        record = self._folder / record_of(variation)
        arrays = record.with_suffix(".npz")
        self._asked |= {record, arrays}
        if record.is_file():
            return read_attempt(record, {fitted.asset.name: fitted})
        outcome = make()
        if isinstance(outcome, Rejection):
            write_json(record, {"rejected": asdict(outcome)})
        else:
            write_bytes(arrays, npz_bytes(_arrays(outcome)))
            write_json(record, {"verified": _header(outcome)})
        return outcome

    def forget_others(self) -> None:
        """Delete attempts that were not asked for since the store was opened."""
        for path in sorted(set((self._folder / FOLDER).glob("*")) - self._asked):
            path.unlink()


def record_of(variation: Variation) -> str:
    """Path of an attempt's record below the stage's folder; each asset has a seed of its own."""
    return f"{FOLDER}/{variation.seed}-{variation.index:05d}.json"


def read_attempt(record: Path, fits: Mapping[str, FittedAsset]) -> Outcome:
    """An attempt by its record.

    Args:
        record: What `AttemptStore` wrote.
        fits: The fits that the stage was given, by name of the asset.

    Raises:
        MissingFileError: A file is missing.
        MalformedFileError: It cannot be read, or names an asset that is not among `fits`.
    """
    content = read_json(record)
    try:
        if "rejected" in content:
            return Rejection(**content["rejected"])
        header = content["verified"]
        if header["asset"] not in fits:
            raise MalformedFileError(
                record, f"asset '{header['asset']}' is unknown", f"known assets: {', '.join(sorted(fits))}"
            )
        return _episode(header, read_npz(record.with_suffix(".npz")), fits[header["asset"]])
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(record, f"is no attempt ({error!r})", "delete it and run again") from error


def _arrays(episode: VerifiedEpisode) -> dict[str, np.ndarray]:
    return {
        **{f"plan_{name}": getattr(episode.plan, name) for name in PLAN_ARRAYS},
        **{f"run_{name}": getattr(episode, name) for name in RUN_ARRAYS},
        **{f"contact_{name}": getattr(episode.contacts, name) for name in CONTACT_ARRAYS},
    }


def _header(episode: VerifiedEpisode) -> dict[str, Any]:
    plan = episode.plan
    return {
        "asset": plan.fitted.asset.name,
        "variation": asdict(plan.variation),
        "fps": plan.fps,
        "grasp": plan.grasp,
        "metrics": dict(plan.metrics),
        "verdict": episode.verdict.as_json(),
    }


def _episode(header: dict[str, Any], arrays: dict[str, np.ndarray], fitted: FittedAsset) -> VerifiedEpisode:
    stored = header["verdict"]
    verdict = Verdict(
        target_theta=stored["target_theta"],
        outcomes=tuple(SettingOutcome(**outcome) for outcome in stored["dynamic"]),
        kinematic=stored["kinematic"],
        bolted=stored["bolted"],
    )
    plan = EpisodePlan(
        variation=Variation(**header["variation"]),
        fitted=fitted,
        fps=header["fps"],
        grasp=header["grasp"],
        metrics=header["metrics"],
        **{name: arrays[f"plan_{name}"] for name in PLAN_ARRAYS},
    )
    contacts = ContactLog(**{name: arrays[f"contact_{name}"] for name in CONTACT_ARRAYS})
    return VerifiedEpisode(
        plan=plan,
        contacts=contacts,
        verdict=verdict,
        **{name: arrays[f"run_{name}"] for name in RUN_ARRAYS},
    )
