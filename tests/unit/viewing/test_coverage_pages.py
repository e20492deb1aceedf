from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.core.plan import Variation
from aomgen.episodes.reach_map import front_line
from aomgen.io.review import Review
from aomgen.viewing.coverage_pages import describe_holes, find_holes, locate_draws, measure_coverage
from aomgen.viewing.draw_list import Draw
from toy_drawer import SUPPORT, fitted_drawer

AREA = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@pytest.mark.parametrize("frame", ["world", "object", "polygon"])
@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_draws_are_placed_as_on_the_map_of_the_report(frame, scale) -> None:
    fitted = fitted_drawer()
    variation = Variation(seed=0, index=0, x=0.3, y=-0.1, yaw=0.7, frame=frame, scale=scale)
    first, last = front_line(fitted, variation, "committed").points_world
    np.testing.assert_allclose(
        locate_draws(fitted, [asdict(variation)])[0], [*first, *(last - first)], atol=1e-12
    )


def test_the_largest_hole_is_found_with_its_reasons() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 1, 11)), -1).reshape(-1, 2)
    episodes = grid[np.linalg.norm(grid - (0.7, 0.3), axis=1) > 0.25]
    others = [(0.7, 0.35, "blocked"), (0.75, 0.3, "out_of_view"), (0.1, 0.1, "off_table")]
    rows = [{"x": x, "y": y, "outcome": "committed", "reason": ""} for x, y in episodes]
    rows += [{"x": x, "y": y, "outcome": "rejected", "reason": reason} for x, y, reason in others]
    first, *more = describe_holes(AREA, rows)
    assert (first["x"], first["y"]) == pytest.approx((0.7, 0.3), abs=0.04)
    assert first["radius_m"] == pytest.approx(0.28, abs=0.03)
    assert (first["draws"], first["reasons"]) == (2, {"blocked": 1, "out_of_view": 1})
    assert all(hole["radius_m"] < 0.12 for hole in more)


def test_an_even_spread_has_no_hole() -> None:
    middles = np.linspace(0.05, 0.95, 10)
    episodes = np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2)
    assert list(find_holes(AREA, episodes)) == []


def test_episodes_that_a_person_rejects_cover_nothing(tmp_path: Path) -> None:
    results = SimpleNamespace(
        params=lambda stage, defaults: defaults,
        fitted_assets=[fitted_drawer()],
        episode_scene=SimpleNamespace(support=SUPPORT, obstacles=()),
        folders={"episodes": tmp_path},
    )
    draws = [
        Draw(number=n, asset="drawer-0", outcome="committed", reason="", detail="", variation=asdict(Variation(seed=0, index=n, x=0.05 * n, y=0.0, yaw=0.0)), content=str(n))
        for n in range(4)
    ]  # fmt: skip
    found = measure_coverage(results, draws, {2: Review(content="2", decision="rejected"), 3: Review(content="old", decision="rejected")}, [0])  # fmt: skip
    assert [row["outcome"] for row in found["draws"]] == ["committed", "committed", "rejected", "committed"]
    x = next(item for item in found["histograms"] if item["name"] == "x")
    assert (sum(x["drawn"]), sum(x["tried"]), sum(x["delivered"])) == (4, 4, 3)
    assert np.shape(found["requested"]) == (1, 4, 2)
