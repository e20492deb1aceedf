"""A plate 3 mm high under a box on a table: heights do not tell it from the table, masks do."""

from typing import cast

import numpy as np

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import gaussians_of
from aomgen.reconstruction.masks.segmenter import PreparedImage
from aomgen.reconstruction.parts.foot import with_foot
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.part_masks import ScanView, drawn_parts
from aomgen.reconstruction.parts.prompted import PromptedImage

# The object's box over the table at z = 0, and the plate under it, which is narrower (x and y, [m]).
LOW, HIGH = np.array([-0.2, -0.15, 0.005]), np.array([0.2, 0.15, 0.2])
PLATE = np.array([0.12, 0.1])
CAMERA = Camera(
    fx=150.0, fy=150.0, cx=80.0, cy=60.0, width=160, height=120, T_world_cam=look_at([0, -0.5, 0.6], [0, 0, 0])
)  # fmt: skip
PANEL = Panel(T_world_panel=np.eye(4), low=LOW, high=HIGH, object_low=LOW, object_high=HIGH)

steps = np.arange(-0.3, 0.3, 0.01)
x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
ON_PLATE = (np.abs(x) < PLATE[0]) & (np.abs(y) < PLATE[1])
SCENE = gaussians_of(
    means=np.stack([x, y, np.where(ON_PLATE, 0.003, 0.0)], 1),
    quats=np.tile([1.0, 0, 0, 0], (len(x), 1)),
    scales=np.tile([0.005, 0.005, 0.001], (len(x), 1)),
    opacities=np.full(len(x), 0.95),
    sh=np.zeros((len(x), 1, 3)),
)


def prompted(part: int, grow: float = 1.0) -> PromptedImage:
    """An image whose mask shows the plate; its box is larger by a factor."""
    mask = drawn_parts(SCENE, np.where(ON_PLATE, STATIC, BACKGROUND).astype(np.uint8), CAMERA)[STATIC]
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]]) + 1
    middle, half = (low + high) / 2, grow * (high - low) / 2
    view = ScanView(
        name="0.jpg", camera=CAMERA, image_srgb=np.zeros((120, 160, 3), np.uint8), robot=np.zeros_like(mask)
    )
    return PromptedImage(
        view=view,
        prepared=cast(PreparedImage, None),
        part=part,
        box=np.concatenate([middle - half, middle + half]),
        masks=(mask,),
    )


def shares(labels: np.ndarray) -> tuple[float, float]:
    """Of the plate and of the table that are static."""
    return float((labels == STATIC)[ON_PLATE].mean()), float((labels == STATIC)[~ON_PLATE].mean())


def test_masks_tell_a_plate_from_the_table() -> None:
    nothing = np.zeros(len(SCENE), np.uint8)
    plate, table = shares(with_foot(SCENE, nothing, PANEL, [prompted(STATIC)]))
    assert plate > 0.9
    assert table < 0.02


def test_a_mask_that_does_not_fill_its_box_is_not_believed() -> None:
    nothing = np.zeros(len(SCENE), np.uint8)
    assert shares(with_foot(SCENE, nothing, PANEL, [prompted(STATIC, grow=1.5)])) == (0.0, 0.0)
    assert shares(with_foot(SCENE, nothing, PANEL, [prompted(MOVING)])) == (0.0, 0.0)


def test_what_has_a_label_keeps_it_and_what_is_elsewhere_stays() -> None:
    labelled = np.full(len(SCENE), ROBOT, np.uint8)
    assert np.array_equal(with_foot(SCENE, labelled, PANEL, [prompted(STATIC)]), labelled)
    nothing = np.full(len(SCENE), BACKGROUND, np.uint8)
    lifted = SCENE.transformed(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1.0]]))
    assert shares(with_foot(lifted, nothing, PANEL, [prompted(STATIC)])) == (0.0, 0.0)
