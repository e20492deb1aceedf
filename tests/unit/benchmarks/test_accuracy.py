"""The scorer gives the error that was put in, and calls a refusal a refusal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.core.camera import Camera, look_at
from aomgen.core.joint import Joint
from aomgen.core.lens import Lens, undistort_labels
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, similarity_parts, transform
from aomgen.errors import MissingFileError
from aomgen.io.images import read_image, write_image
from aomgen.twin.twin import TwinState
from benchmarks.accuracy import score_estimates
from benchmarks.images import TrueMasks, add_ious, is_heldout, masked_psnr, pooled_ious, score_scan
from benchmarks.truth import Truth, read_truth

PINCH = np.array([0.5, 0.1, 0.3])
TIMES = np.arange(20) / 10


class FixedRobot:
    """A robot whose pinch site stands still, so that expected errors can be written down."""

    def ee_poses(self, joints):
        return transform(np.tile(np.eye(3), (len(joints), 1, 1)), np.tile(PINCH, (len(joints), 1)))


@pytest.fixture
def truth() -> Truth:
    angles = np.linspace(0, 5, 30)
    scan = {
        f"{i:04d}.jpg": look_at([2 * np.cos(a), 2 * np.sin(a), 1 + 0.2 * np.sin(3 * a)], [0, 0, 0])
        for i, a in enumerate(angles)
    }
    contacts = [[] for _ in TIMES]
    contacts[5] = [{"finger": "left", "point": [0.5, 0.0, 0.2], "normal": [0, 1, 0], "force": 3.0}]
    return Truth(
        folder=Path(),
        scan=scan,
        demo_cameras={"front": look_at([1, 1, 1], [0, 0, 0])},
        joint=Joint(type="revolute", axis=[0, 0, 1], origin=[0.6, 0.2, 0.0], lower=0, upper=2),
        theta={"front": np.clip((np.arange(20) - 5) * 0.1, 0, 1)},
        start_frame=5,
        end_frame=15,
        clock_offset_s=0.5,
        qpos=np.zeros((20, 6)),
        gripper=np.zeros(20),
        contacts=contacts,
    )


def estimates_of(truth: Truth, E=np.eye(4)) -> dict:
    """What a perfect run whose world frame is off by the similarity E would write."""
    R = similarity_parts(E)[1]

    def moved(T):
        return transform(R @ T[:3, :3], apply(E, T[:3, 3])).tolist()

    return {
        "S_world_recon": E.tolist(),
        "scan": {name: moved(T) for name, T in truth.scan.items()},
        "demo_cameras": {name: moved(T) for name, T in truth.demo_cameras.items()},
        "clock_offset_s": 0.52,
        "start_s": 0.6,
        "end_s": 1.5,
        "joint": {"type": "revolute", "axis": [0, 0, 1], "origin": [0.6, 0.21, 5.0]},
        "theta": {"times_s": TIMES.tolist(), "values": (truth.theta["front"] * 1.1).tolist()},
        "contacts": [{"finger": "left", "point": [0.5, 0.0, 0.21], "normal": [0, 1, 0]}],
    }


def score(estimates: dict, truth: Truth) -> dict:
    return score_estimates(estimates, truth, FixedRobot(), TIMES, "front")


def test_a_perfect_frame_scores_zero_and_the_rest_what_was_put_in(truth):
    figures = score(estimates_of(truth), truth)
    assert figures["alignment.end_effector_mm"] == pytest.approx(0, abs=1e-6)
    assert figures["cameras.median_mm"] == pytest.approx(0, abs=1e-9)
    assert figures["clock_offset_ms_error"] == pytest.approx(20)
    assert figures["keyframes.start_error_s"] == pytest.approx(0.1)
    assert figures["joint.axis_deg"] == pytest.approx(0)
    assert figures["joint.origin_mm"] == pytest.approx(10), "along the axis does not count"
    assert figures["contact_mm"] == pytest.approx(10)
    assert figures["theta.final_error_deg"] == pytest.approx(np.degrees(0.1))
    assert figures["refused"] == []


def test_a_shifted_turned_scaled_world_is_measured(truth):
    E = similarity(1.01, matrix_from_rotvec([0, 0, np.radians(0.5)]), [0.003, 0, 0])
    figures = score(estimates_of(truth, E), truth)
    assert figures["alignment.scale_pct"] == pytest.approx(1.0, abs=1e-6)
    assert figures["alignment.rotation_deg"] == pytest.approx(0.5, abs=1e-6)
    expected = 1e3 * np.linalg.norm(apply(E, PINCH) - PINCH)
    assert figures["alignment.end_effector_mm"] == pytest.approx(expected, abs=1e-6)


def test_misregistered_images_are_listed_and_not_averaged(truth):
    estimates = estimates_of(truth)
    for name in ("0004.jpg", "0017.jpg"):
        estimates["scan"][name] = look_at([-3, 2, 4], [0, 0, 0]).tolist()
    figures = score(estimates, truth)
    assert figures["cameras.misregistered"] == ["0004.jpg", "0017.jpg"]
    assert figures["alignment.end_effector_mm"] < 1e-6


def test_an_opposite_axis_is_wrong(truth):
    estimates = estimates_of(truth)
    estimates["joint"]["axis"] = [0, 0, -1]
    assert score(estimates, truth)["joint.axis_deg"] == pytest.approx(180)


def test_refusals_are_listed(truth):
    estimates = estimates_of(truth) | {"joint": None, "theta": None, "start_s": None, "contacts": []}
    refused = score(estimates, truth)["refused"]
    assert {"joint.type_ok", "theta.rmse_deg", "keyframes.start_error_s", "contact_mm"} <= set(refused)


def test_a_touch_too_light_to_be_known_is_not_refused(truth):
    light = [[item | {"force": 0.5} for item in frame] for frame in truth.contacts]
    figures = score(estimates_of(truth), replace(truth, contacts=light))
    assert figures["contact_mm"] is None
    assert figures["refused"] == []


def test_image_figures():
    assert [index for index in range(20) if is_heldout(index)] == [4, 12]
    image = np.zeros((4, 4, 3), np.uint8)
    real = np.full((4, 4, 3), 51, np.uint8)
    assert masked_psnr(image, real, np.ones((4, 4), bool)) == pytest.approx(-20 * np.log10(0.2))
    labels = np.array([[1, 1, 0, 0]], np.uint8)
    true = np.array([[1, 0, 0, 2]], np.uint8)
    ious: dict[str, list[float]] = {"robot": [], "static": [], "moving": []}
    add_ious(ious, labels, true)
    figures = pooled_ious(ious)
    assert figures["parts.robot_iou"] == pytest.approx(0.5)
    assert figures["parts.static_iou"] == 0.0
    assert figures["parts.moving_iou"] is None


def test_a_capture_without_truth_cannot_be_scored(tmp_path):
    with pytest.raises(MissingFileError, match="cannot be scored"):
        read_truth(tmp_path)


def test_true_masks_are_straightened_where_the_lens_bends(tmp_path):
    lens = Lens(fx=100, fy=100, cx=80, cy=60, width=160, height=120, k1=-0.3)
    labels = np.zeros((120, 160), np.uint8)
    labels[20:50, 100:150] = 3
    write_image(tmp_path / "0004.png", labels)
    plain = TrueMasks(folder=tmp_path)
    assert np.array_equal(plain.read("0004"), labels)
    straight = TrueMasks(folder=tmp_path, lens=lens).read("0004")
    assert np.array_equal(straight, undistort_labels(labels, lens))
    assert not np.array_equal(straight, labels)
    assert plain.has("0004")
    assert not plain.has("0005")


def test_a_scan_without_true_masks_is_scored_by_its_pictures(tmp_path, capture_copy):
    capture = read_capture(capture_copy)
    path = capture.scan_images[4]
    camera = Camera(fx=600, fy=600, cx=320, cy=240, width=640, height=480, T_world_cam=np.eye(4))
    real = read_image(path)

    def render(*_) -> tuple[np.ndarray, np.ndarray]:
        return np.clip(real.astype(int) + 5, 0, 255).astype(np.uint8), np.zeros(real.shape[:2], np.uint8)

    state = TwinState(joints=np.zeros(6), gripper=0.0, theta=0.0, T_world_object=np.eye(4))
    figures, ious = score_scan(capture, {path.name: camera}, state, TrueMasks(folder=tmp_path), render)
    assert figures["images.heldout_views"] == 1
    assert 33 < figures["images.heldout_psnr"] < 36
    assert figures["images.heldout_psnr_objects"] is None
    assert not any(ious.values())
