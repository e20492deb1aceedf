"""Made articulated assets, drawn from a seed."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from aomgen.assets.procedural.furniture import make_cabinet, make_drawer, make_dresser
from aomgen.assets.procedural.lidded import make_laptop, make_toolbox
from aomgen.assets.procedural.microwave import make_microwave
from aomgen.core.asset import ArticulatedAsset
from aomgen.errors import ConfigError

Maker = Callable[[np.random.Generator], ArticulatedAsset]
# The categories of the benchmark.
MAKERS: Final[dict[str, Maker]] = {
    "cabinet": make_cabinet,
    "drawer": make_drawer,
    "laptop": make_laptop,
    "microwave": make_microwave,
    "toolbox": make_toolbox,
}
# Made by name as well: drawers again, of another shape.
OTHER_MAKERS: Final[dict[str, Maker]] = {"dresser": make_dresser}


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
    return make_by(makers[category], category, seed)


def make_by(maker: Maker, category: str, seed: int) -> ArticulatedAsset:
    """What a maker draws for a seed, named after the category."""
    # The name's letters enter the seed, so that categories do not share random numbers.
    rng = np.random.default_rng([seed, *category.encode()])
    return replace(maker(rng), name=f"{category}-{seed}")
