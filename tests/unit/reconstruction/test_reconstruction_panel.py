"""A cabinet with a door, looked at by exact cameras: its panel is hidden and asked back."""

from collections.abc import Sequence

import numpy as np
import pytest

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.transforms import apply, invert, transform
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.parts.panel import Panel
from aomgen.reconstruction.parts.panel_crops import PromptedView, box_misfit, iou
from aomgen.reconstruction.parts.panel_fit import fit_panel
from aomgen.reconstruction.parts.panel_front import panel_frame

# Cabinet frame: x along the front, y into the room, z up; the front is at y = 0, the body behind it.
BODY = np.array([[0.0, 0.0, 0.0], [0.5, 0.35, 0.3]])
DOOR = np.array([[0.03, -0.02, 0.04], [0.36, 0.0, 0.27]])
HANDLE = np.array([[0.31, -0.05, 0.1], [0.33, -0.02, 0.2]])
CABINET = ((BODY, STATIC), (DOOR, MOVING), (HANDLE, MOVING))
# A lid on a lower body: its handle is a bar that stands out past the front edge, between the corners,
# above a book that lies before the body.
LID = np.array([[0.0, 0.0, 0.1], [0.5, 0.35, 0.13]])
BOOK = np.array([[0.05, -0.2, 0.0], [0.45, -0.01, 0.05]])
BAR = np.array([[0.15, -0.05, 0.11], [0.35, -0.03, 0.12]])
CHEST_BODY = np.array([[0.0, 0.0, 0.0], [0.5, 0.35, 0.1]])
CHEST = ((CHEST_BODY, STATIC), (LID, MOVING), (BAR, MOVING), (BOOK, BACKGROUND))
CHEST_EYES = ([-0.3, -1.0, 0.4], [-0.7, -0.7, 0.8], [0.8, -1.0, 0.4], [1.1, -0.8, 0.8])
# The same cabinet with its door open by a quarter turn, its handle on what was the front; a drawer pulled out
# of another one, seen from aside as well; a box whose lid stands upright.
OPEN_DOOR = np.array([[0.01, -0.35, 0.04], [0.03, -0.02, 0.27]])
OPEN_HANDLE = np.array([[-0.02, -0.32, 0.1], [0.01, -0.3, 0.2]])
OPEN_CABINET = ((BODY, STATIC), (OPEN_DOOR, MOVING), (OPEN_HANDLE, MOVING))
DRAWER = ((BODY, STATIC), *((np.array(sides), MOVING) for sides in (
    [[0.05, -0.22, 0.05], [0.45, -0.2, 0.25]], [[0.07, -0.2, 0.06], [0.09, 0.0, 0.18]],
    [[0.41, -0.2, 0.06], [0.43, 0.0, 0.18]], [[0.07, -0.2, 0.06], [0.43, 0.0, 0.07]],
)))  # fmt: skip
UPRIGHT_LID = ((CHEST_BODY, STATIC), (np.array([[0.0, 0.32, 0.1], [0.5, 0.35, 0.45]]), MOVING))
OPEN_EYES = ([-0.7, -0.9, 0.5], [-0.6, -1.0, 0.7], [0.9, -1.0, 0.45], [0.6, -1.2, 0.6])
EYES = ([-0.3, -1.1, 0.5], [0.5, -1.2, 0.7], [0.9, -1.0, 0.45], [0.2, -1.2, 0.3])


def turned(yaw: float) -> np.ndarray:
    """A place of the cabinet in the world (4, 4)."""
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    return transform(R, [0.7, -0.4, 0.0])


def seen_by(
    eye: list[float], size: float = 1.0, yaw: float = 0.0, boxes: Sequence[tuple[np.ndarray, int]] = CABINET
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, surface points (H, W, 3) and part labels (H, W) of the object on a table."""
    T_world_cabinet = turned(yaw)
    place = transform(T_world_cabinet[:3, :3], size * T_world_cabinet[:3, 3])
    T_cabinet_cam = look_at(size * np.array(eye), size * np.array([0.25, 0.1, 0.15]))
    camera = Camera(
        fx=230.0, fy=230.0, cx=100.0, cy=75.0, width=200, height=150, T_world_cam=place @ T_cabinet_cam
    )
    v, u = np.mgrid[:150, :200] + 0.5
    rays = np.stack([(u - 100) / 230, (v - 75) / 230, np.ones_like(u)], -1) @ T_cabinet_cam[:3, :3].T
    origin = T_cabinet_cam[:3, 3]
    nearest, labels = (
        -origin[2] / np.where(rays[..., 2] < 0, rays[..., 2], np.nan),
        np.zeros((150, 200), np.uint8),
    )
    for box, value in boxes:
        with np.errstate(divide="ignore"):
            hits = (size * box[:, None, None] - origin) / rays
        enter, leave = hits.min(0).max(-1), hits.max(0).min(-1)
        closer = (enter < leave) & (enter > 0) & ~(enter > nearest)
        nearest, labels = np.where(closer, enter, nearest), np.where(closer, value, labels)
    points = origin + rays * nearest[..., None]
    return camera, apply(place, points.reshape(-1, 3)).reshape(points.shape), labels


def drawn_box(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)


def prompted(
    size: float = 1.0,
    yaw: float = 0.0,
    masks: str = "none",
    eyes: Sequence[list[float]] = EYES,
    boxes: Sequence[tuple[np.ndarray, int]] = CABINET,
) -> list[PromptedView]:
    """Two boxes of each part; masks are absent, right, or show the upper half of the door only."""
    views = []
    for eye, part in zip(eyes, (STATIC, MOVING, STATIC, MOVING), strict=True):
        camera, points, labels = seen_by(eye, size, yaw, boxes)
        mask = labels == part
        half = mask & (np.arange(150)[:, None] < drawn_box(mask)[[1, 3]].mean())
        answers = {"none": (), "right": (mask,), "half": (half,)}[masks]
        views.append(
            PromptedView(part=part, camera=camera, points_world=points, box=drawn_box(mask), masks=answers)
        )
    return views


def agreement(
    panel: Panel, size: float = 1.0, yaw: float = 0.0, boxes: Sequence[tuple[np.ndarray, int]] = CABINET
) -> dict[int, float]:
    """IoU of each part in a view that no prompt showed."""
    camera, points, labels = seen_by([0.35, -1.0, 0.75], size, yaw, boxes)
    found = panel.labels_seen(points, camera.center)
    return {value: iou(found == value, labels == value) for value in (STATIC, MOVING)}


@pytest.mark.parametrize("masks", ["none", "right", "half"])
def test_the_panel_of_a_cabinet_is_found_from_boxes(masks):
    fit = fit_panel(prompted(masks=masks), np.random.default_rng(0))
    assert np.mean(fit.misfits) < 0.06
    assert min(agreement(fit.panel).values()) > 0.9
    T_panel_cabinet = invert(fit.panel.T_world_panel) @ turned(0.0)
    corners = apply(T_panel_cabinet, DOOR)
    low, high = np.minimum(*corners), np.maximum(*corners)
    assert np.allclose(fit.panel.low[:2], low[:2], atol=0.01)
    assert np.allclose(fit.panel.high[:2], high[:2], atol=0.01)


@pytest.mark.parametrize(("size", "yaw"), [(0.1, 0.0), (1.0, 2.2), (8.0, -0.9)])
def test_size_and_place_of_the_cabinet_do_not_matter(size, yaw):
    fit = fit_panel(prompted(size, yaw), np.random.default_rng(0))
    assert min(agreement(fit.panel, size, yaw).values()) > 0.9


@pytest.mark.parametrize(
    "eyes",
    [
        ([0.22, -0.73, 0.3], [1.01, -1.18, 0.5], [0.79, -1.11, 0.58], [-0.65, -0.87, 0.58]),
        ([-0.36, -1.13, 0.36], [0.81, -1.13, 0.88], [0.43, -0.91, 0.57], [-0.14, -1.12, 0.86]),
    ],
)
def test_the_seam_behind_the_panel_is_found_from_wherever_it_is_looked_at(eyes):
    """From these places a seam at twice or five times the door's thickness explains the boxes nearly as well."""
    fit = fit_panel(prompted(masks="right", eyes=eyes), np.random.default_rng(0))
    assert fit.panel.low[2] == pytest.approx(DOOR[0, 1], abs=0.003)


@pytest.mark.parametrize("boxes", [OPEN_CABINET, DRAWER, UPRIGHT_LID], ids=["door", "drawer", "lid"])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_parts_that_were_scanned_open_have_their_own_box(boxes, yaw):
    views = prompted(yaw=yaw, masks="right", eyes=OPEN_EYES, boxes=boxes)
    fit = fit_panel(views, np.random.default_rng(0))
    assert np.mean(fit.misfits) < 0.06
    # A drawer may still be explained as a thick front: less of it is right then.
    assert min(agreement(fit.panel, yaw=yaw, boxes=boxes).values()) > 0.84


def test_the_table_before_an_open_door_stays_table():
    panel = fit_panel(
        prompted(masks="right", eyes=OPEN_EYES, boxes=OPEN_CABINET), np.random.default_rng(0)
    ).panel
    around = np.random.default_rng(0).uniform([-0.1, -0.4, -0.01], [0.3, -0.1, 0.01], (500, 3))
    assert np.mean(panel.labels(apply(turned(0.0), around)) > 0) < 0.02
    handle = np.random.default_rng(0).uniform(*OPEN_HANDLE, (200, 3))
    assert np.mean(panel.labels(apply(turned(0.0), handle)) == MOVING) > 0.95


def test_boxes_drawn_a_little_wrong_still_give_the_panel():
    rng = np.random.default_rng(3)
    views = []
    for view in prompted(masks="right"):
        box = view.box + rng.uniform(-0.03, 0.03, 4) * np.tile(view.box[2:] - view.box[:2], 2)
        views.append(
            PromptedView(
                part=view.part, camera=view.camera, points_world=view.points_world, box=box, masks=view.masks
            )
        )
    fit = fit_panel(views, rng)
    assert min(agreement(fit.panel).values()) > 0.88


def test_boxes_around_different_things_are_not_explained():
    views = prompted()
    moving, static = views[1], views[0]
    table = np.array([20.0, 120.0, 60.0, 145.0])
    for right in (moving, static):
        wrong = PromptedView(
            part=right.part, camera=right.camera, points_world=right.points_world, box=table, masks=()
        )
        others = [view for view in views if view is not right]
        assert explained([wrong, *others]) > 0.3


def explained(views: list[PromptedView]) -> float:
    """Mean misfit, infinite when the boxes show no common front."""
    try:
        return float(np.mean(fit_panel(views, np.random.default_rng(0)).misfits))
    except ReconstructionError:
        return np.inf


def test_a_box_that_shows_no_surface_is_refused():
    views = prompted()
    empty = np.full_like(views[1].points_world, np.nan)
    hidden = PromptedView(part=MOVING, camera=views[1].camera, points_world=empty, box=views[1].box, masks=())
    with pytest.raises(ReconstructionError, match="0 pixels of surface"):
        fit_panel([views[0], hidden, views[3]], np.random.default_rng(0))


def test_a_bar_past_the_edge_that_no_box_shows_is_found_by_the_masks():
    views = []
    for eye, part in zip(CHEST_EYES, (STATIC, MOVING, STATIC, MOVING), strict=True):
        camera, points, labels = seen_by(eye, boxes=CHEST)
        mask = labels == part
        views.append(
            PromptedView(part=part, camera=camera, points_world=points, box=drawn_box(mask), masks=(mask,))
        )
    panel = fit_panel(views, np.random.default_rng(0)).panel
    bar = apply(turned(0.0), np.random.default_rng(0).uniform(*BAR, (200, 3)))
    book = apply(turned(0.0), np.random.default_rng(0).uniform(*BOOK, (200, 3)))
    assert np.mean(panel.labels(bar) == MOVING) > 0.95
    assert not (panel.labels(book) == MOVING).any()


def test_bars_past_the_edge_end_where_the_object_begins():
    panel = Panel.of_shape(
        np.eye(4), np.array([0, 1, 0, 1, -0.05, 0.1, 0, 0.3, 0, 0, -0.8, 0, 0.2, 0.5, 0, 0]), margin_m=0.01
    )
    points = [[-0.1, 0.5, -0.02], [-0.005, 0.5, -0.02], [-0.1, 0.5, -0.1], [-0.3, 0.5, 0], [0.5, -0.1, 0]]
    assert panel.labels(points).tolist() == [MOVING, STATIC, BACKGROUND, BACKGROUND, BACKGROUND]
    points = [[1.2, 0.5, -0.02], [1.2, 0.5, 0.05], [1.4, 0.5, -0.02], [1.6, 0.5, 0.05]]
    assert panel.labels(points).tolist() == [STATIC, MOVING, MOVING, BACKGROUND]


def test_what_shows_through_a_front_is_the_front():
    panel = Panel.of_shape(
        np.eye(4), np.array([0, 1, 0, 1, -0.05, 0.1, 0.2, 0.2, 0.0, 0.2, -0.8, *[0.0] * 5]), margin_m=0.0
    )
    inside = np.array([[[0.5, 0.5, -0.4]], [[1.1, 0.5, -0.4]], [[0.5, 0.5, -2.0]]])
    assert panel.labels(inside.reshape(-1, 3)).tolist() == [STATIC, STATIC, BACKGROUND]
    front = panel.labels_seen(inside, np.array([0.5, 0.5, 3.0]))
    assert front.ravel().tolist() == [MOVING, STATIC, BACKGROUND]
    behind = panel.labels_seen(inside, np.array([0.5, 0.5, -3.0]))
    assert behind.ravel().tolist() == [STATIC, STATIC, BACKGROUND]
    unseen = panel.labels_seen(np.full((1, 1, 3), np.nan), np.array([0.5, 0.5, 3.0]))
    assert unseen.item() == BACKGROUND


@pytest.mark.parametrize("up", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_outer_faces_have_some_thickness_but_not_the_one_that_lies_on_a_table(up, sign):
    """The world stands on each face of the object in turn."""
    rows = np.roll(np.eye(3), 2 - up, axis=0)
    rows[2] *= sign
    rows[1] *= sign
    panel = Panel.of_shape(
        transform(rows, np.zeros(3)), np.array([0, 1, 0, 1, -0.05, 0.1, 0, 0, 0, 0, -0.8, *[0] * 5]), 0.01
    )
    low, high = np.array([0, 0, -0.8]), np.array([1, 1, 0])
    thickness = np.concatenate([low - panel.object_low, panel.object_high - high])
    down = up if sign > 0 else up + 3
    assert thickness == pytest.approx(np.where(np.arange(6) == down, 0.0, 0.01))
    # Before the front there may be handles, which are no outer face.
    outside = [[-0.005, 0.5, -0.4], [0.5, -0.005, -0.4], [0.5, 0.5, -0.805]]
    outside += [[1.005, 0.5, -0.4], [0.5, 1.005, -0.4]]
    found = panel.labels_local(np.array(outside))
    assert (found == np.where(np.arange(5) == down, BACKGROUND, STATIC)).all()


def test_labels_move_with_the_panel():
    rng = np.random.default_rng(5)
    shape = np.array([0, 1, 0, 1, -0.05, 0.1, 0.2, 0.1, 0.3, 0.2, -0.8, 0, 0.1, 0, 0, 0.2])
    points = rng.uniform(-1, 1.5, (4000, 3))
    there = Panel.of_shape(np.eye(4), shape, 0.01).labels(points)
    assert set(there.tolist()) == {BACKGROUND, STATIC, MOVING}
    T = turned(1.1)
    assert np.array_equal(Panel.of_shape(T, shape, 0.01).labels(apply(T, points)), there)


def test_misfit_is_zero_for_a_mask_that_fills_its_box_and_grows_with_what_is_wrong():
    box = np.array([20.0, 10.0, 80.0, 50.0])
    mask = np.zeros((60, 100), bool)
    assert box_misfit(mask, box) == 4.0
    mask[10:50, 20:80] = True
    assert box_misfit(mask, box) == 0.0
    larger = np.kron(mask, np.ones((3, 3), bool))
    assert box_misfit(larger, 3 * box) == 0.0
    short = mask.copy()
    short[:, 50:] = False
    assert box_misfit(short, box) == pytest.approx(0.5)
    speck = mask.copy()
    speck[55, 5] = True
    assert box_misfit(speck, box) < 0.01
    elsewhere = np.roll(mask, 15, axis=1)
    assert box_misfit(elsewhere, box) == pytest.approx(0.25 + 0.25 + 2 * 0.25)


def flat(rng: np.random.Generator, normal: list[float], noise: float) -> np.ndarray:
    """Points (N, 3) of a 0.4 x 0.2 rectangle at (1, 0, 1), a fifth of them strays."""
    n = np.array(normal) / np.linalg.norm(normal)
    across = np.cross([0.1, 0.2, 0.97], n)
    across /= np.linalg.norm(across)
    count = 2000
    points = rng.uniform([-0.2, -0.1], [0.2, 0.1], (count, 2)) @ np.stack([across, np.cross(n, across)])
    points = points + rng.normal(0, noise, (count, 1)) * n + [1.0, 0.0, 1.0]
    strays = rng.uniform([0.8, -0.2, 0.8], [1.2, 0.2, 1.2], (count // 5, 3))
    return np.concatenate([points, strays])


@pytest.mark.parametrize(
    ("normal", "want"),
    [([-1, 0.3, 0.05], [-1, 0.3, 0]), ([-1, 0.2, 0.9], [-1, 0.2, 0.9]), ([0.02, 0.03, 1], [0, 0, 1])],
)
def test_fronts_face_the_camera_and_are_upright_or_level_when_they_nearly_are(normal, want):
    rng = np.random.default_rng(7)
    points = [flat(rng, normal, 0.002), flat(rng, normal, 0.002)]
    T, size = panel_frame(points, np.array([[1.0, 0, 1]]) + 2 * np.array([normal]), rng)
    assert np.degrees(np.arccos(np.clip(T[:3, 2] @ want / np.linalg.norm(want), -1, 1))) < 1.0
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert 0.2 < size < 0.5
    assert abs((T[:3, 3] - [1, 0, 1]) @ T[:3, 2]) < 0.005
    turned_away, _ = panel_frame(points, np.array([[1.0, 0, 1]]) - 2 * np.array([normal]), rng)
    assert turned_away[:3, 2] @ T[:3, 2] < -0.99
