"""Verified episodes between planning and rendering: arrays in one npz, the rest in one JSON file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.assets.archive import load_asset, save_asset
from aomgen.core.episode import ContactLog
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.core.verdict import SettingOutcome, Verdict
from aomgen.errors import CorruptArtifactError
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.jsonfile import read_json

PLAN_ARRAYS = ("T_world_object", "joints", "gripper", "thetas", "phases", "Ts_world_ee")
REACHED_ARRAYS = ("joints", "gripper", "thetas", "Ts_world_ee")
CONTACT_ARRAYS = ("frames", "fingers", "points_world", "normals_world", "forces")
FITTED_ARRAYS = ("T_world_asset", "contact_asset", "shares", "thetas")
FITTED_VALUES = ("scale", "mirrored", "mode", "residual_mm")


def save_fitted(folder: Path, fitted: FittedAsset) -> None:
    """Write a fitted asset as `asset.npz` and `fitted.json` into a folder."""
    save_asset(fitted.asset, folder / "asset.npz")
    write_json(
        folder / "fitted.json", {name: getattr(fitted, name) for name in (*FITTED_ARRAYS, *FITTED_VALUES)}
    )


def load_fitted(folder: Path) -> FittedAsset:
    """Read what `save_fitted` wrote.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
        CorruptArtifactError: The JSON is of something else.
    """
    path = folder / "fitted.json"
    try:
        return FittedAsset(asset=load_asset(folder / "asset.npz"), **read_json(path))
    except (TypeError, ValueError) as error:
        raise CorruptArtifactError(path, f"is not a fitted asset ({error})", "run the stage again") from error


def save_verified(folder: Path, verified: list[VerifiedEpisode]) -> None:
    """Write verified episodes into a folder, in order."""
    arrays: dict[str, np.ndarray] = {}
    entries = []
    for index, item in enumerate(verified):
        for group, source, names in (
            ("plan", item.plan, PLAN_ARRAYS),
            ("reached", item, REACHED_ARRAYS),
            ("contact", item.contacts, CONTACT_ARRAYS),
        ):
            arrays.update({f"{index:05d}_{group}_{name}": getattr(source, name) for name in names})
        variation = item.plan.variation
        entries.append(
            {
                "asset": item.plan.fitted.asset.name,
                "variation": {name: getattr(variation, name) for name in ("seed", "index", "x", "y", "yaw")},
                "fps": item.plan.fps,
                "grasp": item.plan.grasp,
                "metrics": dict(item.plan.metrics),
                "verdict": item.verdict.as_json(),
            }
        )
    write_bytes(folder / "verified.npz", npz_bytes(arrays))
    write_json(folder / "verified.json", entries)


def load_verified(folder: Path, fitted: Mapping[str, FittedAsset]) -> list[VerifiedEpisode]:
    """Read what `save_verified` wrote.

    Args:
        folder: Of the plans.
        fitted: Fitted assets by their asset's name.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
        CorruptArtifactError: The files do not belong together.
    """
    entries = read_json(folder / "verified.json")
    arrays = read_npz(folder / "verified.npz")
    try:
        return [_verified(entry, index, arrays, fitted) for index, entry in enumerate(entries)]
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptArtifactError(
            folder / "verified.json", f"does not fit its arrays or assets ({error!r})", "run the stage again"
        ) from error


def _verified(
    entry: dict[str, Any], index: int, arrays: Mapping[str, np.ndarray], fitted: Mapping[str, FittedAsset]
) -> VerifiedEpisode:
    def group(name: str, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {field: arrays[f"{index:05d}_{name}_{field}"] for field in fields}

    plan = EpisodePlan(
        variation=Variation(**entry["variation"]),
        fitted=fitted[entry["asset"]],
        fps=entry["fps"],
        grasp=entry["grasp"],
        metrics=entry["metrics"],
        **group("plan", PLAN_ARRAYS),
    )
    verdict = entry["verdict"]
    return VerifiedEpisode(
        plan=plan,
        contacts=ContactLog(**group("contact", CONTACT_ARRAYS)),
        verdict=Verdict(
            target_theta=verdict["target_theta"],
            outcomes=tuple(SettingOutcome(**outcome) for outcome in verdict["dynamic"]),
            kinematic=verdict["kinematic"],
            bolted=verdict["bolted"],
        ),
        **group("reached", REACHED_ARRAYS),
    )
