import numpy as np
import pytest

from aomgen.errors import NoMotionError
from aomgen.prompting.video_regions import compare_states, find_moved_region, find_robot_boxes
from aomgen.segmentation.interface import wrap_masks

SIZE = (96, 128)
DOOR = (slice(30, 70), slice(20, 40))
OPENED = (slice(30, 75), slice(44, 70))
ARM = (slice(10, 60), slice(90, 110))


def film() -> tuple[np.ndarray, np.ndarray]:
    """40 frames of a dark door that is opened from frame 20 on by an arm that leaves first, and the arm's masks."""
    frames = np.full((40, *SIZE, 3), 120, np.uint8)
    robot = np.zeros((40, *SIZE), bool)
    for k, frame in enumerate(frames):
        rows, columns = ARM
        robot[k, rows, columns.start + 2 * k : columns.stop + 2 * k] = True
        frame[DOOR] = 30  # the inside is as dark as the door
        if k > 20:
            frame[OPENED] = 30
        frame[robot[k]] = 220
    return frames, robot


class Segments:
    """An encoded image whose segments are given."""

    def __init__(self, *segments: tuple[slice, slice]) -> None:
        self.masks = [np.zeros(SIZE, bool) for _ in segments]
        for mask, segment in zip(self.masks, segments, strict=True):
            mask[segment] = True

    def mask(self, part, box_px, points):
        raise AssertionError("points are asked for")

    def at_points(self, points_px):
        return wrap_masks(self.masks, SIZE)


def test_the_robot_is_what_leaves_its_first_position_early():
    frames, _ = film()
    x0, y0, x1, y1 = find_robot_boxes(frames)[0]
    assert y0 == pytest.approx(ARM[0].start, abs=3)
    assert y1 == pytest.approx(ARM[0].stop, abs=3)
    # The door opens too late to count, and what the arm passes is covered for a moment only.
    assert x0 == pytest.approx(ARM[1].start, abs=3)
    assert x1 == pytest.approx(ARM[1].stop, abs=3)


def test_a_robot_that_the_border_divides_has_a_larger_box_as_well():
    frames, _ = film()
    frames[:5, 80:92, 10:24] = 220
    small, large = find_robot_boxes(frames)
    assert small[0] > 80
    assert large[0] == pytest.approx(10, abs=3)
    assert large[2] == small[2]


def test_a_video_in_which_nothing_leaves_is_refused_in_one_sentence():
    with pytest.raises(NoMotionError, match="nothing is seen to leave its position") as caught:
        find_robot_boxes(np.full((30, *SIZE, 3), 90, np.uint8))
    assert "aomgen prompts" in caught.value.remedy


def test_the_moved_part_is_found_where_it_has_come_to():
    frames, robot = film()
    _, changed, seen = compare_states(frames, robot, 20, 25)
    assert changed[OPENED].mean() > 0.9
    assert not changed[DOOR].any()
    table = (slice(0, 96), slice(0, 76))
    found = find_moved_region(Segments(DOOR, OPENED, table), changed, seen, np.array([68.0, 50.0]))
    assert found[OPENED].all()
    assert found.sum() == 45 * 26


def test_nothing_that_moved_at_the_gripper_is_refused():
    frames, robot = film()
    _, changed, seen = compare_states(frames, robot, 20, 25)
    with pytest.raises(NoMotionError, match="nothing at the gripper"):
        find_moved_region(Segments(DOOR), changed, seen, np.array([38.0, 50.0]))
    with pytest.raises(NoMotionError, match="nothing at the gripper"):
        find_moved_region(Segments(OPENED), changed, seen, np.array([110.0, 90.0]))
