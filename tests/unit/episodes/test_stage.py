"""Ranges are refused only where no draw can become an episode."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aomgen.core.demonstration import SupportPlane
from aomgen.core.plan import FittedAsset, Variation
from aomgen.core.transforms import apply
from aomgen.episodes import stage
from aomgen.episodes.ledger import Unit
from aomgen.episodes.screening import Place
from aomgen.episodes.stage import check_ranges
from aomgen.episodes.variations import Ranges, draw
from aomgen.errors import ConfigError
from aomgen.robots.robot import Reach


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_draws_are_screened_at_their_size(
    fitted: FittedAsset, scale: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table that is too narrow for the fitted object has room for a small one."""
    low, high = fitted.asset.static.bounds
    middle = apply(fitted.T_world_asset, fitted.middle_asset)[:2] + [0.0, 0.5]
    half = 0.3 * np.max(high - low)
    ranges = Ranges(
        polygon=tuple((float(x), float(y)) for x, y in middle + 1e-3 * np.array([[-1, -1], [1, -1], [0, 1]])),
        yaw_deg=(0.0, 0.0),
        scale=(scale, scale),
    )
    place = Place(
        ranges=ranges,
        support=SupportPlane(height=0.05, low_xy=middle - half, high_xy=middle + half),
        obstacles=(),
        reach=Reach(shoulder_world=np.zeros(3), reach_m=5.0),
        cameras={},
    )

    def vary(unit: Unit) -> Variation:
        return draw(0, unit.asset, unit.index, ranges)

    factory: Any = SimpleNamespace(
        results=SimpleNamespace(fitted_assets=[fitted]),
        reach_maps=[SimpleNamespace(may_reach=lambda variation: True)],
        place=place,
        variation=vary,
    )
    refusal = ConfigError("episodes.ranges", "no feasible pose", "choose others")
    monkeypatch.setattr(stage, "_refusal", lambda factory, fitted, reasons, picture: refusal)
    if scale < 1.0:
        check_ranges(factory, tmp_path)
    else:
        with pytest.raises(ConfigError):
            check_ranges(factory, tmp_path)
