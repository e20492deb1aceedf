"""Parts of several colors: the segmenter finds a piece, and what fills the box joins it."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.recording import Prompt
from aomgen.errors import ReconstructionError
from aomgen.parts.panel_terms import box_misfit
from aomgen.parts.prompted_images import segment_prompts
from aomgen.parts.scan_views import ScanView
from aomgen.segmentation.interface import Mask, PointMasks, wrap_masks

SHAPE = (80, 100)
BOX = np.array([20.0, 20.0, 70.0, 60.0])


def rectangle(x0: int, y0: int, x1: int, y1: int) -> Mask:
    mask = np.zeros(SHAPE, bool)
    mask[y0:y1, x0:x1] = True
    return mask


# A drawer in its box: a tray, and a front of another color; the table behind both goes on outside.
TRAY, FRONT, TABLE = rectangle(35, 20, 70, 60), rectangle(20, 20, 35, 60), rectangle(0, 10, 100, 80)


class Pieces:
    """A segmenter that knows things by their color: it answers boxes with one of them."""

    def __init__(self, answer: Mask) -> None:
        self.answer = answer

    def prepare(self, name: str, image_srgb: np.ndarray) -> "Pieces":
        return self

    def mask(self, part: str, box_px: np.ndarray, points: np.ndarray) -> Mask:
        return self.answer

    def at_points(self, points_px: np.ndarray) -> PointMasks:
        things = (TRAY, FRONT, TABLE & ~TRAY & ~FRONT)
        found = [m for x, y in points_px for m in things if m[int(y), int(x)]]
        return wrap_masks(found, SHAPE)


def asked(answer: Mask, robot: Mask | None = None, box: np.ndarray = BOX) -> tuple[Mask, ...]:
    camera = Camera(
        fx=90.0, fy=90.0, cx=50.0, cy=40.0, width=100, height=80, T_world_cam=look_at([0, -1, 0.5], [0, 0, 0])
    )
    view = ScanView(
        name="a.jpg",
        camera=camera,
        image_srgb=np.zeros((*SHAPE, 3), np.uint8),
        robot=np.zeros(SHAPE, bool) if robot is None else robot,
    )
    prompts = tuple(
        Prompt(part=part, image="a.jpg", points=np.zeros((0, 3)), box=box) for part in ("static", "moving")
    )
    return segment_prompts([view], prompts, Pieces(answer))[1].masks


def test_a_piece_is_joined_with_the_one_that_fills_the_box():
    found = min(asked(TRAY), key=lambda mask: box_misfit(mask, BOX))
    assert np.array_equal(found, TRAY | FRONT)


def test_a_mask_that_fills_its_box_stays_alone():
    whole = TRAY | FRONT
    assert all(np.array_equal(mask, whole) for mask in asked(whole))


def test_what_goes_on_outside_the_box_is_not_joined():
    wide = np.array([10.0, 15.0, 75.0, 70.0])
    found = min(asked(TRAY, box=wide), key=lambda mask: box_misfit(mask, wide))
    assert not (found & ~TRAY & ~FRONT).any()


def test_the_robot_is_never_joined():
    hand = rectangle(20, 20, 26, 60)
    assert all(not (mask & hand).any() for mask in asked(TRAY, robot=hand))


def test_parts_without_a_box_are_refused():
    with pytest.raises(ReconstructionError, match="static"):
        segment_prompts([], (), Pieces(TRAY))
