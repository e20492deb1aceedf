"""Tables of the errors of located keypoints."""

import numpy as np
import pytest

from aomgen.evaluation.finder_errors import format_errors, summarize_points


def test_errors_that_are_known_are_summarized() -> None:
    errors_mm = np.full((11, 5), np.nan)
    errors_mm[:, 0] = np.arange(0, 22, 2)
    table = summarize_points(errors_mm)
    assert table["grasp"] == {
        "number": 11,
        "median_mm": 10.0,
        "p90_mm": 18.0,
        "within_10_mm": pytest.approx(6 / 11),
    }
    assert table["axis_1"] == {"number": 0}
    lines = format_errors(table, "error").splitlines()
    assert len(lines) == 2
    assert lines[1].split() == ["grasp", "11", "10.0", "mm", "18.0", "mm", "0.55"]
