"""Fixed cameras come back from disk as they were calibrated, and damaged files are named."""

import json

import numpy as np
import pytest

from aomgen.alignment.bundle_adjustment import drifts
from aomgen.alignment.calibrated_cameras import (
    CAMERAS_FILE,
    load_calibrated_cameras,
    save_calibrated_cameras,
)
from aomgen.core.camera import Camera, look_at
from aomgen.core.clock import Clock
from aomgen.core.fixed_camera import FixedCamera
from aomgen.errors import MalformedFileError, MissingFileError, SyncError

CAMERA = Camera(
    fx=300.0, fy=310.0, cx=160.0, cy=121.0, width=320, height=240,
    T_world_cam=look_at([-1.5, -1.0, 0.9], [0.0, 0.0, 0.3]),
)  # fmt: skip
CLOCK = Clock(offset_s=0.7, sd_s=0.002, rate=0.01, rate_sd=0.001, middle_s=4.0)


def test_cameras_come_back_as_they_were(tmp_path) -> None:
    good = FixedCamera(camera=CAMERA, clock=CLOCK, note="refined", figures={"moved_mm": 1.5})
    refused = FixedCamera(camera=CAMERA, clock=None, refusal=("clock", "drifts", "export"), trusted=False)
    save_calibrated_cameras({"front": good, "side": refused}, tmp_path)
    back = load_calibrated_cameras(tmp_path)
    assert list(back) == ["front", "side"]
    assert back["front"].camera.T_world_cam == pytest.approx(CAMERA.T_world_cam)
    assert (back["front"].clock, back["front"].figures) == (CLOCK, {"moved_mm": 1.5})
    assert back["front"].warnings("front") == []
    with pytest.raises(SyncError, match="drifts"):
        back["side"].require_clock()
    assert len(back["side"].warnings("side")) == 2


def test_a_folder_without_cameras_is_named(tmp_path) -> None:
    with pytest.raises(MissingFileError):
        load_calibrated_cameras(tmp_path)


@pytest.mark.parametrize("change", ["no cameras", "no clock", "crooked pose", "list", "not JSON"])
def test_a_damaged_file_is_malformed(tmp_path, change: str) -> None:
    save_calibrated_cameras({"front": FixedCamera(camera=CAMERA, clock=CLOCK)}, tmp_path)
    path = tmp_path / CAMERAS_FILE
    stored = json.loads(path.read_text())
    if change == "no cameras":
        del stored["cameras"]
    elif change == "no clock":
        del stored["cameras"]["front"]["clock"]
    elif change == "crooked pose":
        stored["cameras"]["front"]["camera"]["T_world_cam"] = [[1.0, 2.0]]
    elif change == "list":
        stored["cameras"] = [1, 2]
    path.write_text("{" if change == "not JSON" else json.dumps(stored))
    with pytest.raises(MalformedFileError):
        load_calibrated_cameras(tmp_path)


def test_a_clock_tells_log_times_about_its_middle() -> None:
    assert CLOCK.log_times([4.0]) == pytest.approx([4.7])
    assert np.diff(CLOCK.log_times([0.0, 8.0])) == pytest.approx([8.08])


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
