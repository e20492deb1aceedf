"""Boxes and their edges."""

import numpy as np
import pytest

from aomgen.errors import InputError
from aomgen.motion.box_edges import find_footprint_yaw, fit_upright_box
from boxy_microwave import BODY, DOOR, YAW


def test_a_box_has_twelve_edges_of_three_directions() -> None:
    box = fit_upright_box(BODY, find_footprint_yaw(BODY))
    edges = box.edges()
    assert edges.shape == (12, 2, 3)
    assert len(np.unique(np.round(edges.mean(1), 6), axis=0)) == 12
    assert 2 * np.sort(box.half_extents) == pytest.approx([0.26, 0.34, 0.44], abs=0.01)


def test_the_yaw_of_a_turned_box_is_found() -> None:
    assert find_footprint_yaw(BODY) == pytest.approx(YAW, abs=np.radians(1))


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="need 20"):
        fit_upright_box(DOOR[:5], 0.0)
