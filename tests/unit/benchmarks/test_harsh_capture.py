"""A worse copy of a capture is wrong by what is said, and still a capture."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.capture_check import check_capture
from aomgen.capture.read import read_capture
from aomgen.core.lens import Lens, undistort_labels
from aomgen.io.images import read_image, read_labels
from benchmarks.harsh_capture import FOCAL_SHARE, JOINT_ZERO_RAD, K1, degrade_capture
from synthetic.scene_recording import Conditions
from synthetic.world import make_capture

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A clean capture and its worse copy."""
    folder = tmp_path_factory.mktemp("degrade")
    clean, worse = folder / "clean", folder / "worse"
    conditions = Conditions(size=(160, 120), scan_views=12, fps=4)
    make_capture(clean, category="drawer", seed=4, conditions=conditions)
    degrade_capture(clean, worse, np.random.default_rng(0))
    return clean, worse


def test_it_is_a_capture_that_is_wrong_as_stated(captures: tuple[Path, Path]) -> None:
    clean, worse = (read_capture(folder) for folder in captures)
    check_capture(worse)
    assert clean.scan_intrinsics is not None
    assert worse.scan_intrinsics is not None
    assert worse.scan_intrinsics.fx == pytest.approx((1 + FOCAL_SHARE) * clean.scan_intrinsics.fx, rel=1e-4)
    first = np.abs(worse.joint_log.joints[0] - clean.joint_log.joints[0])
    np.testing.assert_allclose(first, JOINT_ZERO_RAD, atol=1e-5)
    lost = 1 - len(worse.joint_log.times_s) / len(clean.joint_log.times_s)
    assert 0 < lost < 0.05
    assert np.all(np.diff(worse.joint_log.times_s) > 0)
    for before, after in zip(clean.prompts, worse.prompts, strict=True):
        assert 0 < np.abs(after.points[0, :2] - before.points[0, :2]).max() <= 3.1


def test_labels_are_seen_through_the_same_lens(captures: tuple[Path, Path]) -> None:
    """Straightened by the true lens, the worse copy's labels are the clean ones again."""
    clean, worse = captures
    stated = read_capture(clean).scan_intrinsics
    assert stated is not None
    true = Lens(fx=stated.fx, fy=stated.fy, cx=stated.cx, cy=stated.cy, width=160, height=120, k1=K1)
    still = Path("truth", "masks", "scan", "0008.png")
    before = read_labels(clean / still)
    after = read_labels(worse / still)
    straight = undistort_labels(after, true)
    assert np.mean(after != before) > 0.002
    # `straight` may be magnified a little, so it is compared where it was taken from.
    pixels = true.source_pixels()
    rays = true.rays(pixels.reshape(-1, 2))
    at = np.floor(rays * [true.fx, true.fy] + [true.cx, true.cy]).astype(int).clip(0, [159, 119])
    assert np.mean(straight.ravel() != before[at[:, 1], at[:, 0]]) < 0.01


def test_stills_differ_in_exposure(captures: tuple[Path, Path]) -> None:
    clean, worse = captures
    names = [path.name for path in read_capture(clean).scan_images]
    gains = [read_image(worse / "scan" / n).mean() / read_image(clean / "scan" / n).mean() for n in names]
    assert np.ptp(gains) > 0.05
