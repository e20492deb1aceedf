"""A fixed camera tells its clock or why it has none."""

import numpy as np
import pytest

from aomgen.core.alignment import Clock, FixedCamera
from aomgen.core.camera import Camera, look_at
from aomgen.errors import SyncError

CAMERA = Camera(
    fx=300.0, fy=310.0, cx=160.0, cy=121.0, width=320, height=240,
    T_world_cam=look_at([-1.5, -1.0, 0.9], [0.0, 0.0, 0.3]),
)  # fmt: skip
CLOCK = Clock(offset_s=0.7, sd_s=0.002, rate=0.01, rate_sd=0.001, middle_s=4.0)


def test_a_refused_clock_is_said_again_and_warned_of() -> None:
    good = FixedCamera(camera=CAMERA, clock=CLOCK)
    assert good.require_clock() is CLOCK
    assert good.warnings("front") == []
    refused = FixedCamera(camera=CAMERA, clock=None, refusal=("clock", "drifts", "export"), trusted=False)
    with pytest.raises(SyncError, match="drifts"):
        refused.require_clock()
    assert len(refused.warnings("side")) == 2


def test_a_clock_tells_log_times_about_its_middle() -> None:
    assert CLOCK.log_times([4.0]) == pytest.approx([4.7])
    assert np.diff(CLOCK.log_times([0.0, 8.0])) == pytest.approx([8.08])
