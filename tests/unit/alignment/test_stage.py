"""The stage selects the images of the scan's robot pose and gives each camera its clock."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aomgen.alignment import stage as module
from aomgen.alignment.fixed_camera_calibration import FixedCameraVideo
from aomgen.alignment.pose_search import Scan
from aomgen.core.alignment import Alignment
from aomgen.core.camera import Camera
from aomgen.core.progress import silent
from aomgen.core.recording import JointLog
from aomgen.io.video import Video
from small_alignment import ALIGNMENT

CAMERA = Camera(fx=1, fy=1, cx=1, cy=1, width=2, height=2, T_world_cam=np.eye(4))
RESTING = [0.1, -0.4]
ALIGNED = replace(
    ALIGNMENT,
    joint_zeros_rad=np.array([0.02, np.radians(-0.5)]),
    joint_zero_sds_rad=np.zeros(2),
)


def aligned_views(
    monkeypatch: pytest.MonkeyPatch, scan_joints: list[float], clock_offset_s: float | None = None
) -> list[str]:
    """Names of the images that `align_scan` uses; the arm of the log rests for a second, then moves."""
    scans: list[Scan] = []
    monkeypatch.setattr(module, "align", lambda scan, *others: scans.append(scan))
    monkeypatch.setattr(module, "camera_errors_of", lambda structure: None)
    monkeypatch.setattr(module, "read_image", lambda path: np.zeros((2, 2, 3), np.uint8))
    times = np.arange(200) / 50
    travel = np.clip(times - 1, 0, None)[:, None]
    log = JointLog(
        times_s=times, joints=np.array(RESTING) + travel, gripper=0 * times, joint_names=("a", "b")
    )
    capture = SimpleNamespace(
        prompts=(),
        joint_log=log,
        clock_offset_s=clock_offset_s,
        robot=SimpleNamespace(scan_joints=np.array(scan_joints), scan_gripper=0.0),
    )
    results = SimpleNamespace(
        pinhole_capture=capture,
        structure=SimpleNamespace(
            cameras_recon={"0001.jpg": CAMERA},
            demo_cameras_recon={"front": CAMERA},
            points_recon=np.zeros((3, 3)),
        ),
        videos={"front": SimpleNamespace(frames_srgb=np.zeros((3, 2, 2, 3), np.uint8))},
        scan_images={"0000.jpg": "", "0001.jpg": ""},
        params=lambda stage, default: default,
        configuration_in=lambda capture: None,
    )
    module.align_scan(results, silent)
    return [view.name for view in scans[0].views]


@pytest.mark.parametrize(
    ("scan_joints", "clock_offset_s", "used"),
    [
        (RESTING, None, True),
        ([0.1, -0.404], None, True),
        ([0.1, -0.1], None, False),
        (RESTING, 0.5, True),
        # The video begins while the arm moves.
        (RESTING, 1.3, False),
    ],
)
def test_first_frames_are_used_only_if_they_show_the_configuration_of_the_scan(
    monkeypatch: pytest.MonkeyPatch, scan_joints: list[float], clock_offset_s: float | None, used: bool
) -> None:
    assert ("front" in aligned_views(monkeypatch, scan_joints, clock_offset_s)) is used


def test_a_stated_clock_offset_belongs_to_the_first_camera(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calibrated: dict[str, FixedCameraVideo] = {}

    def calibrate(
        scan: object, videos: dict[str, FixedCameraVideo], progress: object, params: object
    ) -> Alignment:
        calibrated.update(videos)
        return ALIGNED

    monkeypatch.setattr(module, "calibrate_fixed_cameras", calibrate)
    video = Video(times_s=np.zeros(1), frames_srgb=np.zeros((1, 2, 2, 3), np.uint8), fps=10.0)
    cameras = [SimpleNamespace(name=name, T_world_cam=None) for name in ("front", "side")]
    results = SimpleNamespace(
        pinhole_capture=SimpleNamespace(cameras=cameras, joint_log=None, clock_offset_s=0.7),
        structure=SimpleNamespace(
            cameras_recon={},
            demo_cameras_recon={"front": CAMERA, "side": CAMERA},
            points_recon=np.zeros((3, 3)),
        ),
        videos={"front": video, "side": video},
        scan_images={},
        configuration_in=lambda capture: None,
        # The first joint is a rail, whose zero is not an angle.
        robot=SimpleNamespace(slides=np.array([True, False])),
    )
    figures = module.calibrate_cameras(results, ALIGNED, tmp_path, silent)
    assert figures["largest_joint_zero_deg"] == pytest.approx(0.5)
    assert [(name, item.clock_offset_s) for name, item in calibrated.items()] == [
        ("front", 0.7),
        ("side", None),
    ]
