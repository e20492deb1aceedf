"""Fit every asset to the recorded object, and keep the fits: one folder for each asset."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from aomgen.assets.archive import load_asset, save_asset
from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.demonstration import Demonstration, RecordedObject
from aomgen.core.plan import Adaptation, FittedAsset
from aomgen.core.progress import Progress
from aomgen.core.verdict import Rejection
from aomgen.errors import AssetError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json
from aomgen.replacement.fitting import FitParams, fit_asset
from aomgen.replacement.recorded import recorded_contact

FITS_FILE = "fits.json"
FIELDS = ("T_world_asset", "contact_asset", "shares", "thetas", "scale", "mirrored", "mode", "residual_mm")


def run_fitting(
    assets: Sequence[ArticulatedAsset],
    demo: Demonstration,
    recorded: RecordedObject,
    mode: Adaptation,
    folder: Path,
    progress: Progress,
    params: FitParams | None = None,
) -> list[FittedAsset]:
    """Fit all assets; those that do not fit are named in `fits.json` with the reason.

    Writes for each fit the scaled asset as `<name>.npz` (exact) and `<name>.usda` (self-contained).

    Raises:
        EstimationError: The recorded object has no front (see `frontal`).
        AssetError: No asset fits.
        StorageError: The disk refuses.
    """
    contact = recorded_contact(demo, recorded)
    fits: list[FittedAsset] = []
    refused: dict[str, dict] = {}
    for number, asset in enumerate(assets):
        result = fit_asset(asset, contact, demo.joint.type, mode, params or FitParams())
        if isinstance(result, Rejection):
            refused[asset.name] = asdict(result)
        else:
            fits.append(result)
            save_asset(result.asset, folder / f"{asset.name}.npz")
            write_usd(result.asset, folder / f"{asset.name}.usda")
        progress((number + 1) / len(assets), asset.name)
    if not fits:
        reasons = "; ".join(f"{name}: {item['reason']} ({item['detail']})" for name, item in refused.items())
        raise AssetError("assets", f"none fits the recorded object ({reasons})", "choose other assets")
    rows = [{"name": fit.asset.name, **{field: getattr(fit, field) for field in FIELDS}} for fit in fits]
    write_json(folder / FITS_FILE, {"fits": rows, "refused": refused})
    return fits


def load_fitting(folder: Path) -> list[FittedAsset]:
    """The fits of a finished stage.

    Raises:
        MissingFileError, MalformedFileError: As their names say.
    """
    result = []
    for row in read_json(folder / FITS_FILE)["fits"]:
        values = {field: row[field] for field in FIELDS}
        for name in ("T_world_asset", "contact_asset", "shares", "thetas"):
            values[name] = np.array(values[name])
        result.append(FittedAsset(asset=load_asset(folder / f"{row['name']}.npz"), **values))
    return result
