"""Number of assets that the recorded motions fit, the pads' contact with them, and why the others do not fit."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.choice import make_asset
from aomgen.core.plan import Rejection
from aomgen.errors import ConfigError, EstimationError, ReconstructionError
from aomgen.replacement.fitting import FitParams, fit_asset
from benchmarks.grip_on_meshes import grip_on_meshes
from benchmarks.motion_worlds import motion_world
from benchmarks.recovered import MAX_WORLDS, OTHER_OBJECT, recorded_motion
from benchmarks.replay_runs import CATEGORIES

# Assets of each category, none of which was recorded.
ASSETS: Final = 10


def run_fits(folder: Path, seed: int, notify: Callable[[str], None]) -> dict[str, Any]:
    """Scale generated assets to motions recovered from videos of other objects; worlds are kept."""
    rows = [_fits(category, seed, folder, notify) for category in CATEGORIES]
    residuals, gaps, depths = (
        [value for row in rows for value in row[name]] for name in ("contact_mm", "gap_mm", "penetration_mm")
    )
    count = ASSETS * len(rows)
    return {
        "accepted_share": len(residuals) / count,
        "contact_mm": float(np.median(residuals)),
        "contact_mm_worst": float(np.max(residuals)),
        "gap_mm": float(np.median(gaps)),
        "gap_mm_worst": float(np.max(gaps)),
        "penetration_mm": float(np.median(depths)),
        "penetration_mm_worst": float(np.max(depths)),
        "assets": count,
        "categories": rows,
    }


def _fits(category: str, seed: int, folder: Path, notify: Callable[[str], None]) -> dict[str, Any]:
    """Fit assets to the first world from a seed whose motion is recovered."""
    refused: list[str] = []
    for number in range(seed, seed + MAX_WORLDS):
        notify(f"film {category}-{number}")
        try:
            given = motion_world(category, number, folder / "worlds", "open").demonstration
            demo, _, contact, _ = recorded_motion(given, "opening")
        except (ConfigError, EstimationError, ReconstructionError) as error:
            refused.append(f"{category}-{number}: {error}")
            continue
        assets = [make_asset(category, number + OTHER_OBJECT + k) for k in range(ASSETS)]
        found = [fit_asset(asset, contact, demo.joint.type, "object", FitParams()) for asset in assets]
        fits = [item for item in found if not isinstance(item, Rejection)]
        grips = [grip_on_meshes(item, demo, given.robot) for item in fits]
        return {
            "category": category,
            "world": number,
            "refused": refused,
            "contact_mm": [round(item.residual_mm, 2) for item in fits],
            "scales": [round(item.scale, 3) for item in fits],
            "gap_mm": [round(item.gap_mm, 2) for item in grips],
            "penetration_mm": [round(item.penetration_mm, 2) for item in grips],
            "grasps_before": [item.tried for item in grips],
            "rejects": [f"{item.reason}: {item.detail}" for item in found if isinstance(item, Rejection)],
        }
    raise EstimationError(
        f"category {category}", f"no motion is recovered ({'; '.join(refused)})", "another --seed"
    )
