"""Parametric articulated assets, drawn from a seed."""

from collections.abc import Callable
from typing import Final

import numpy as np

from aomgen.assets.cabinet import make_cabinet
from aomgen.assets.cupboard import make_cupboard
from aomgen.assets.drawer import make_drawer
from aomgen.assets.dresser import make_dresser
from aomgen.assets.laptop import make_laptop
from aomgen.assets.microwave import make_microwave
from aomgen.assets.oven import make_oven
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
# Made by name as well, to see whether methods hold beyond those five.
OTHER_MAKERS: Final[dict[str, Maker]] = {
    "cupboard": make_cupboard,
    "dresser": make_dresser,
    "oven": make_oven,
}


def make_asset(category: str, seed: int) -> ArticulatedAsset:
    """A new asset of a category; the same seed gives the same asset.

    Args:
        category: One of `MAKERS` or `OTHER_MAKERS`.
        seed: Chooses sizes, colors, prints and the hinge side.

    Returns:
        A hollow, textured asset in the asset frame (front towards -y, support plane z = 0,
        centred in x), closed at joint value 0.

    Raises:
        ConfigError: The category is unknown.
    """
    makers = MAKERS | OTHER_MAKERS
    if category not in makers:
        raise ConfigError("category", f"{category!r} is unknown", f"choose one of {', '.join(makers)}")
    # The name's letters enter the seed, so that categories do not share random numbers.
    rng = np.random.default_rng([seed, *category.encode()])
    return makers[category](f"{category}-{seed}", rng)
