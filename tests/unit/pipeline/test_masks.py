"""`aomgen masks`: what is written where, with a stand-in for the network."""

import numpy as np
import pytest

from aomgen.capture.read import read_capture
from aomgen.conventions import STATIC
from aomgen.core.progress import silent
from aomgen.errors import BackendError, ConfigError
from aomgen.io.images import read_labels
from aomgen.pipeline import masks
from aomgen.pipeline.masks import write_masks


@pytest.fixture
def follower(monkeypatch):
    """Labels everything; says in which order it was given images."""
    seen = []

    def carry(tracker, names, image_of, prompts, progress):
        seen.extend(names)
        for name in names:
            yield name, np.full(image_of(name).shape[:2], STATIC, np.uint8)

    monkeypatch.setattr(masks, "find_sam2", lambda name: None)
    monkeypatch.setattr(masks, "load_tracker", lambda files: None)
    monkeypatch.setattr(masks, "carry_prompts", carry)
    return seen


def test_masks_of_all_images_are_written_and_found(capture_copy, follower):
    before = read_capture(capture_copy)
    target = write_masks(capture_copy, "small", silent)
    assert target == capture_copy / "masks" / "small"
    after = read_capture(capture_copy)
    assert "small" in after.mask_folders
    assert follower == sorted(path.name for path in before.scan_images)
    assert {path.stem for path in target.glob("*.png")} == {path.stem for path in before.scan_images}
    assert np.all(read_labels(next(target.glob("*.png"))) == STATIC)
    with pytest.raises(ConfigError, match="exists already"):
        write_masks(capture_copy, "small", silent)


def test_a_failure_leaves_no_masks(capture_copy, follower, monkeypatch):
    def fail(*arguments):
        yield "0000.jpg", np.zeros((4, 4), np.uint8)
        # While it is at work nobody sees half of the masks.
        assert not any(".staging" in name for name in read_capture(capture_copy).mask_folders)
        raise BackendError("network", "broke")

    monkeypatch.setattr(masks, "carry_prompts", fail)
    with pytest.raises(BackendError, match="broke"):
        write_masks(capture_copy, "small", silent)
    assert "small" not in read_capture(capture_copy).mask_folders
    assert not list((capture_copy / "masks").iterdir())
