"""Parametric articulated assets, drawn from a seed."""

from collections.abc import Callable
from typing import Final

import numpy as np

from aomgen.assets.cabinet import make_cabinet
from aomgen.assets.drawer import make_drawer
from aomgen.assets.laptop import make_laptop
from aomgen.assets.microwave import make_microwave
from aomgen.assets.toolbox import make_toolbox
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import ConfigError

Maker = Callable[[str, np.random.Generator], ArticulatedAsset]
# The categories of the benchmark.
MAKERS: Final[dict[str, Maker]] = {
    "cabinet": make_cabinet,
    "drawer": make_drawer,
    "laptop": make_laptop,
    "microwave": make_microwave,
    "toolbox": make_toolbox,
}


def make_asset(category: str, seed: int) -> ArticulatedAsset:
    """A new asset of a category; the same seed gives the same asset.

    Args:
        category: One of `MAKERS`.
        seed: Chooses sizes, colors, prints and the hinge side.

    Returns:
        A hollow, textured asset in the asset frame (front towards -y, support plane z = 0,
        centred in x), closed at joint value 0.

    Raises:
        ConfigError: The category is unknown.
    """
    if category not in MAKERS:
        raise ConfigError("category", f"{category!r} is unknown", f"choose one of {', '.join(MAKERS)}")
    # The name's letters enter the seed, so that categories do not share random numbers.
    rng = np.random.default_rng([seed, *category.encode()])
    return MAKERS[category](f"{category}-{seed}", rng)
