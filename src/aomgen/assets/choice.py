"""Open the articulated assets that users name: parametric assets given by category and seed, and USD files."""

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

# Entry of a project's assets that stands for the recorded object, which is available only after reconstruction.
ORIGINAL: Final = "original"


def make_asset(category: str, seed: int, style: str = "") -> ArticulatedAsset:
    """Make a parametric asset of a category; the same seed gives the same asset.

    Args:
        category: One of `MAKERS` or `OTHER_MAKERS`.
        seed: Chooses style, sizes, colors, prints and the hinge side.
        style: One of `list_styles`; replaces the style that the seed selects.

    Returns:
        A hollow, textured asset in the asset frame (front toward -y, support plane z = 0, centered in x), which is
        closed at joint value 0.

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
    """List the styles of a parametric category; seed 1 has the first one, and the seeds cycle through them.

    Raises:
        KeyError: The category is not parametric; a programming error, see `is_made`.
    """
    return list(design(category)[STYLES])


def style_of_seed(category: str, seed: int) -> str:
    """Return the style of a parametric category that a seed selects."""
    styles = list_styles(category)
    # The style is not random, so that consecutive seeds cover all styles.
    return styles[(seed - 1) % len(styles)]


def make_by(maker: Maker, category: str, seed: int) -> ArticulatedAsset:
    """Make an asset from a seed, and name it `<category>-<seed>`.

    Args:
        maker: Function that makes an asset from a generator.
        category: Category of the asset.
        seed: Seed of the generator, together with the category.
    """
    # The category's name is part of the seed, so that categories do not share random numbers.
    rng = np.random.default_rng([seed, *category.encode()])
    return replace(maker(rng), name=f"{category}-{seed}")


def is_made(category: str) -> bool:
    """Return whether a category is parametric."""
    return category in MAKERS | OTHER_MAKERS


def suggest_category(category: str) -> str:
    """Suggest a parametric category with a name similar to an unknown one."""
    return suggest(category, MAKERS | OTHER_MAKERS)


def asset_file(spec: str) -> tuple[Path, str] | None:
    """Split FILE or FILE#JOINT into the path of a USD file and the joint's name; None for other entries of `assets`."""
    file, _, joint = spec.partition("#")
    return (Path(file), joint) if Path(file).suffix.lower() in SUFFIXES else None


def resolve_asset(spec: str) -> str:
    """Make the path of an entry of `assets` absolute; names of parametric assets remain as they are."""
    return str(Path(spec).resolve()) if asset_file(spec) else spec


def load_asset(spec: str) -> ArticulatedAsset:
    """Load the asset that `category:seed`, a USD file or FILE#JOINT names, without checking whether it can be used.

    Raises:
        ConfigError: The text has none of these forms, or the category is unknown.
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
    """Load the asset that an entry of a project names, and check that it can be used.

    Raises:
        ConfigError, AssetError, InputError: See `load_asset`.
        AssetError: The asset cannot be simulated or grasped.
    """
    return require_usable(load_asset(spec))


def require_usable(asset: ArticulatedAsset) -> ArticulatedAsset:
    """Return the asset unchanged if it can be used.

    Raises:
        AssetError: The asset cannot be simulated or grasped.
    """
    problems = check_asset(asset)
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise AssetError(asset.name, problems[0] + more, "see `aomgen assets check`, or choose another one")
    return asset


def open_assets(specs: Sequence[str]) -> list[ArticulatedAsset]:
    """Open all assets of a project except the recorded object itself.

    Raises:
        ConfigError, AssetError, InputError: See `open_asset`.
        AssetError: Two assets have the same name; episodes identify assets by name.
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
