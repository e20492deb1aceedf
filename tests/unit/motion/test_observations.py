"""Observations of a video whose touch is short, and the rate of the used frames."""

from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.errors import NoMotionError
from aomgen.motion.ee_path import GripperPath
from aomgen.motion.inputs import GripperSignals, find_touch
from aomgen.motion.keyframes import ChangeFractions, find_interval
from aomgen.motion.observations import VideoObservations, choose_frame_step


def test_a_gripper_that_only_arrives_in_the_last_frame_moves_nothing() -> None:
    times = np.arange(30) / 15.0
    signals = GripperSignals(
        times_s=times,
        Ts_world_ee=np.tile(np.eye(4), (30, 1, 1)),
        speeds_m_s=np.zeros(30),
        gripper=np.zeros(30),
        distances_m=np.linspace(0.6, 0.02, 30),
    )
    # The last of the dense times is before that of the last frame.
    dense = np.arange(times[0], times[-1], 0.01)
    way = GripperPath(times_s=dense, points=np.stack([dense, 0 * dense, 0 * dense], 1))
    touch = find_touch(signals)
    assert touch.first == touch.last == 29
    seen = ChangeFractions(times_s=times, touch=touch, left=np.zeros(30), ahead=np.zeros(30))
    view = VideoObservations(
        camera=None,
        frames_srgb=np.zeros((30, 4, 4, 3), np.uint8),
        masks=np.zeros((30, 4, 4), bool),
        signals=signals,
        way=way,
        seen=seen,
        interval=find_interval(seen, way, 0.002),
    )
    evidence = view.weigh_motion(SimpleNamespace(scene=None, labels=None))
    assert evidence.travel_m == 0
    with pytest.raises(NoMotionError, match="does not move"):
        evidence.check()


@pytest.mark.parametrize(
    ("fps", "step"), [(10.0, 1), (15.0, 1), (25.0, 1), (29.97, 2), (30.0, 2), (59.94, 4), (60.0, 4)]
)
def test_fast_videos_are_thinned_to_15_frames_per_second_or_more(fps: float, step: int) -> None:
    assert choose_frame_step(fps) == step
