"""When a clock's drift counts, and which joint zeros are refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.alignment.bundle_adjustment import drifts, refuse_large_zeros
from aomgen.alignment.bundle_terms import Bundle, BundleParams, BundleSolution
from aomgen.core.alignment import Clock
from aomgen.errors import AlignmentError

ARM = SimpleNamespace(joint_names=("rail", "hinge"), slides=np.array([True, False]))


def solution(*zeros: float) -> BundleSolution:
    return BundleSolution(
        S_world_recon=np.eye(4), zeros_rad=np.array(zeros), zero_sds_rad=np.full(2, 0.001), cameras={}
    )


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


@pytest.mark.parametrize(
    ("rail_m", "hinge_rad", "message"),
    [
        (0.008, 0.03, r"'rail': is \+8.0 mm \(\+-1.0\) .* limit 5 mm"),
        (0.004, -0.04, r"'hinge': is -2.3 deg \(\+-0.1\) .* limit 2 deg"),
    ],
)
def test_large_zeros_are_refused_in_the_unit_of_their_joint(
    rail_m: float, hinge_rad: float, message: str
) -> None:
    with pytest.raises(AlignmentError, match=message):
        refuse_large_zeros(ARM, solution(rail_m, hinge_rad))
    refuse_large_zeros(ARM, solution(0.004, 0.03))


def test_zeros_of_rails_have_a_prior_in_meters() -> None:
    problem = SimpleNamespace(
        arm=SimpleNamespace(robot=ARM, zeros_rad=np.zeros(2)),
        drawing=SimpleNamespace(pivot=np.zeros(3)),
        views=[],
        cameras={},
        params=BundleParams(zero_sd_rad=0.005, zero_sd_m=0.001),
    )
    zeros = next(term for term in Bundle(problem).priors() if term.name == "joint zeros")
    assert zeros.sd == pytest.approx([0.001, 0.005])
