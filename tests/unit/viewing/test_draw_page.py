"""The page of an episode states angles in degrees and lengths in millimeters."""

from dataclasses import asdict

import numpy as np
import pytest

from aomgen.core.plan import Variation
from aomgen.viewing.draw_page import describe_variation, list_series
from drawer_episode import drawer_episode

# The first of six arm joints is a rail.
RAIL = (0,)


def test_offsets_at_the_start_have_units() -> None:
    offset = (0.02, np.deg2rad(-8.0), *np.zeros(4))
    variation = asdict(Variation(seed=0, index=0, x=0.0, y=0.0, yaw=0.0, start_offset=offset))
    assert describe_variation(variation, RAIL)["start"].startswith("+20 mm, -8 deg, +0 deg")
    assert "start" not in describe_variation({**variation, "start_offset": ()}, RAIL)


@pytest.mark.parametrize("slides", [RAIL, ()])
def test_positions_of_slides_are_plotted_in_millimeters(slides: tuple[int, ...]) -> None:
    joints = np.full((4, 6), 0.5)
    verdict = {"start_theta": 0.0, "target_theta": 0.2}
    plots = list_series(drawer_episode(0, joints, np.zeros(4), {}, verdict, {}), slides)
    by_title = {plot["title"]: plot for plot in plots}
    turning = by_title["arm joints"]
    assert (turning["unit"], len(turning["lines"])) == ("deg", 6 - len(slides))
    np.testing.assert_allclose(turning["lines"][0]["values"], np.degrees(0.5), atol=1e-4)
    assert ("sliding arm joints" in by_title) == bool(slides)
    if slides:
        sliding = by_title["sliding arm joints"]
        assert (sliding["unit"], sliding["lines"]) == ("mm", [{"name": "a", "values": [500.0] * 4}])
