"""Poses in the folder of the scan images: read, reported by the check, and part of the capture's digest."""

import json
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.capture_check import check_capture
from aomgen.capture.read import read_capture
from aomgen.capture.scan_poses import SCAN_POSES_FILE
from aomgen.errors import ScanPoseError
from aomgen.pipeline.stages import capture_digest


def write_poses(capture: Path, names: list[str], T: np.ndarray) -> None:
    data = {"format": 1, "metric": True, "T_scan_cam": {name: T.tolist() for name in names}}
    (capture / "scan" / SCAN_POSES_FILE).write_text(json.dumps(data), "utf-8")


def test_poses_are_read_and_described(capture_copy: Path) -> None:
    before = read_capture(capture_copy)
    assert before.scan_poses is None
    names = [path.name for path in before.scan_images]
    write_poses(capture_copy, [*names[:60], "gone.jpg"], np.eye(4))
    capture = read_capture(capture_copy)
    assert capture.scan_poses is not None
    assert capture.scan_poses.metric
    assert capture.scan_images == before.scan_images
    assert capture_digest(capture) != capture_digest(before)
    _, facts, warnings = check_capture(capture)
    assert "64 images, 640 x 480, 60 with a pose in meters" in facts
    (warning,) = [sentence for sentence in warnings if SCAN_POSES_FILE in sentence]
    assert "1 images that are not in the scan (gone.jpg)" in warning


def test_mirrored_poses_are_refused(capture_copy: Path) -> None:
    write_poses(capture_copy, ["0000.jpg"], np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(ScanPoseError, match=r"0000.jpg mirrors space"):
        read_capture(capture_copy)
