"""When a clock's drift counts."""

import pytest

from aomgen.alignment.bundle_adjustment import drifts
from aomgen.core.alignment import Clock


@pytest.mark.parametrize(
    ("rate", "rate_sd", "seconds", "drifting"),
    [
        (0.02, 0.001, 8.0, True),
        (-0.02, 0.001, 8.0, True),
        # Half a step between drifts tried is no knowledge.
        (0.0114, 0.0057, 8.7, False),
        # Too little to shift the ends of the film.
        (0.004, 0.0001, 8.0, False),
        (0.0, 0.0, 8.0, False),
    ],
)
def test_a_drift_counts_when_it_matters_and_is_known(rate, rate_sd, seconds, drifting) -> None:
    clock = Clock(offset_s=0.2, sd_s=0.001, rate=rate, rate_sd=rate_sd)
    assert drifts(clock, seconds) is drifting
