"""The assets that a project names: made ones by category and seed, others as USD files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from aomgen.assets.asset_check import require_usable
from aomgen.assets.make import MAKERS, OTHER_MAKERS, make_asset
from aomgen.assets.usd_read import SUFFIXES, read_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import AssetError, ConfigError
from aomgen.io.schema import suggest


def asset_file(spec: str) -> Path | None:
    """The USD file that an entry of `assets` names, or None when it names a category and a seed."""
    return Path(spec) if Path(spec).suffix.lower() in SUFFIXES else None


def open_asset(spec: str) -> ArticulatedAsset:
    """The asset that a project names: `category:seed`, or a USD file.

    Raises:
        ConfigError: Neither of the two, or a category that cannot be made.
        AssetError, InputError: The asset cannot be read or used.
    """
    file = asset_file(spec)
    category, _, seed = spec.rpartition(":")
    if file is not None:
        asset = read_usd(file)
    elif seed.isdecimal() and category:
        _require_maker(category, spec)
        asset = replace(make_asset(category, int(seed)), name=f"{category}-{seed}")
    else:
        raise ConfigError(
            "assets", f"'{spec}' is neither category:seed nor a USD file", "for example microwave:1"
        )
    require_usable(asset)
    return asset


def open_assets(specs: Sequence[str]) -> list[ArticulatedAsset]:
    """All assets of a project.

    Raises:
        ConfigError, AssetError, InputError: See `open_asset`.
        AssetError: Two have one name, by which episodes tell them apart.
    """
    assets = [open_asset(spec) for spec in specs]
    for index, asset in enumerate(assets):
        for earlier, other in zip(specs[:index], assets[:index], strict=True):
            if other.name == asset.name:
                raise AssetError(
                    "assets",
                    f"'{earlier}' and '{specs[index]}' are both named '{asset.name}'",
                    "name each asset once; a USD file is named by its default prim",
                )
    return assets


def is_made(category: str) -> bool:
    """Whether assets of a category can be made."""
    return category in MAKERS | OTHER_MAKERS


def suggest_category(category: str) -> str:
    """What a user may have meant by a category that cannot be made."""
    return suggest(category, MAKERS | OTHER_MAKERS)


def _require_maker(category: str, spec: str) -> None:
    if not is_made(category):
        raise ConfigError(
            "assets", f"'{spec}': no asset of category '{category}' can be made", suggest_category(category)
        )
