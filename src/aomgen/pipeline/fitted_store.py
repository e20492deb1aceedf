"""Fitted assets between the stages: the asset's archive, the rest in one JSON file."""

from pathlib import Path

from aomgen.assets.archive import load_asset, save_asset
from aomgen.core.plan import FittedAsset
from aomgen.errors import CorruptArtifactError
from aomgen.io.atomic import write_json
from aomgen.io.jsonfile import read_json

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
