"""Articulated assets by the names that users give them: procedural ones of a seed, and USD files; all checked."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.asset_check import check_asset
from aomgen.assets.procedural.builder import STYLES, design, style_table
from aomgen.assets.procedural.furniture import make_cabinet, make_drawer
from aomgen.assets.procedural.lidded import make_laptop, make_toolbox
from aomgen.assets.procedural.microwave import make_microwave
from aomgen.assets.usd_read import SUFFIXES, read_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import AssetError, ConfigError, suggest

Maker = Callable[[np.random.Generator], ArticulatedAsset]
StyledMaker = Callable[[np.random.Generator, Mapping[str, Any]], ArticulatedAsset]
# Generators of the five categories.
MAKERS: Final[dict[str, StyledMaker]] = {
    "cabinet": make_cabinet,
    "drawer": make_drawer,
    "laptop": make_laptop,
    "microwave": make_microwave,
    "toolbox": make_toolbox,
}
# A sixth name, whose objects belong to the category drawer and have several equal fronts.
OTHER_MAKERS: Final[dict[str, StyledMaker]] = {"dresser": make_drawer}

# Name of the recorded object among the assets of a project; it is not known before it is reconstructed.
ORIGINAL: Final = "original"


def make_asset(category: str, seed: int, style: str = "") -> ArticulatedAsset:
    """A new asset of a category; the same seed gives the same asset.

    Args:
        category: One of `MAKERS` or `OTHER_MAKERS`.
        seed: Chooses style, sizes, colors, prints and the hinge side.
        style: One of `list_styles` instead of the seed's.

    Returns:
        A hollow, textured asset in the asset frame (front towards -y, support plane z = 0,
        centred in x), closed at joint value 0.

    Raises:
        ConfigError: The category or the style is unknown.
    """
    if not is_made(category):
        known = ", ".join(MAKERS | OTHER_MAKERS)
        raise ConfigError("category", f"{category!r} is unknown", f"choose one of {known}")
    styles = list_styles(category)
    chosen = style or style_of_seed(category, seed)
    if chosen not in styles:
        raise ConfigError("style", f"{style!r} is unknown", f"choose one of {', '.join(styles)}")
    maker, table = (MAKERS | OTHER_MAKERS)[category], style_table(category, chosen)
    return make_by(lambda rng: maker(rng, table), category, seed)


def list_styles(category: str) -> list[str]:
    """Styles of a made category; seed 1 has the first one, and after the last one they start again."""
    return list(design(category)[STYLES])


def style_of_seed(category: str, seed: int) -> str:
    """Return the style of a made category that a seed chooses."""
    styles = list_styles(category)
    # No random number, so that consecutive seeds show all styles.
    return styles[(seed - 1) % len(styles)]


def make_by(maker: Maker, category: str, seed: int) -> ArticulatedAsset:
    """Make an asset from a seed, and name it after the category."""
    # The name's letters enter the seed, so that categories do not share random numbers.
    rng = np.random.default_rng([seed, *category.encode()])
    return replace(maker(rng), name=f"{category}-{seed}")


def is_made(category: str) -> bool:
    """Return whether assets of a category can be made."""
    return category in MAKERS | OTHER_MAKERS


def suggest_category(category: str) -> str:
    """Suggest a known category for one that cannot be made."""
    return suggest(category, MAKERS | OTHER_MAKERS)


def asset_file(spec: str) -> tuple[Path, str] | None:
    """The USD file that an entry of `assets` names, and its joint, or None when it names a category and a seed."""
    file, _, joint = spec.partition("#")
    return (Path(file), joint) if Path(file).suffix.lower() in SUFFIXES else None


def load_asset(spec: str) -> ArticulatedAsset:
    """The asset that `category:seed`, a USD file or FILE#JOINT names, whether or not it can be used.

    Raises:
        ConfigError: None of these, or a category that cannot be made.
        AssetError, InputError: The asset cannot be read.
    """
    file = asset_file(spec)
    if file is not None:
        return read_usd(*file)
    category, _, seed = spec.rpartition(":")
    if not (seed.isdecimal() and category):
        problem = f"'{spec}' is neither category:seed nor a USD file"
        raise ConfigError("assets", problem, "for example microwave:1")
    if not is_made(category):
        problem = f"'{spec}': no asset of category '{category}' can be made"
        raise ConfigError("assets", problem, suggest_category(category))
    return make_asset(category, int(seed))


def open_asset(spec: str) -> ArticulatedAsset:
    """The asset that a project names.

    Raises:
        ConfigError, AssetError, InputError: See `load_asset`; also where it cannot be simulated and held.
    """
    return require_usable(load_asset(spec))


def require_usable(asset: ArticulatedAsset) -> ArticulatedAsset:
    """The asset itself.

    Raises:
        AssetError: It cannot be simulated and held.
    """
    problems = check_asset(asset)
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise AssetError(asset.name, problems[0] + more, "see `aomgen assets check`, or choose another one")
    return asset


def open_assets(specs: Sequence[str]) -> list[ArticulatedAsset]:
    """All assets of a project but the recorded object itself.

    Raises:
        ConfigError, AssetError, InputError: See `open_asset`.
        AssetError: Two have the same name; episodes identify assets by name.
    """
    opened: dict[str, str] = {}
    assets = []
    for spec in specs:
        name = ORIGINAL
        if spec != ORIGINAL:
            assets.append(open_asset(spec))
            name = assets[-1].name
        if name in opened:
            raise AssetError(
                "assets",
                f"'{opened[name]}' and '{spec}' are both named '{name}'",
                "name each asset once; a USD file is named by its default prim",
            )
        opened[name] = spec
    return assets
