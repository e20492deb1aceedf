"""A cabinet with a door, looked at by exact cameras: its panel is hidden and asked back; Gaussians cut at its faces."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.parts import no_cut
from aomgen.core.transforms import apply, invert, matrix_from_quat, matrix_from_rotvec, transform
from aomgen.errors import ReconstructionError
from aomgen.parts.panel import MIN_SHARE, UNKNOWNS, YAW, Panel, _find_plane, cut_at_faces, find_panel_frame
from aomgen.parts.panel_fit import fit_panel
from aomgen.parts.panel_terms import PromptedView, TrackedPoints, box_misfit, iou
from aomgen.splatting.rasterizer import render

# Cabinet frame: x along the front, y into the room, z up; the front is at y = 0, the body behind it.
BODY = np.array([[0.0, 0.0, 0.0], [0.5, 0.35, 0.3]])
DOOR = np.array([[0.03, -0.02, 0.04], [0.36, 0.0, 0.27]])
HANDLE = np.array([[0.31, -0.05, 0.1], [0.33, -0.02, 0.2]])
CABINET = ((BODY, STATIC), (DOOR, MOVING), (HANDLE, MOVING))
CHEST_BODY = np.array([[0.0, 0.0, 0.0], [0.5, 0.35, 0.1]])
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


@pytest.mark.parametrize("masks", ["none", "half"])
def test_the_panel_of_a_cabinet_is_found_from_boxes(masks):
    panel, misfits = fit_panel(prompted(masks=masks), np.random.default_rng(0))
    assert np.mean(misfits) < 0.06
    assert min(agreement(panel).values()) > 0.9
    T_panel_cabinet = invert(panel.T_world_panel) @ turned(0.0)
    corners = apply(T_panel_cabinet, DOOR)
    low, high = np.minimum(*corners), np.maximum(*corners)
    assert np.allclose(panel.low[:2], low[:2], atol=0.01)
    assert np.allclose(panel.high[:2], high[:2], atol=0.01)


@pytest.mark.parametrize(("size", "yaw"), [(0.1, 0.0), (8.0, -0.9)])
def test_size_and_pose_of_the_cabinet_do_not_matter(size, yaw):
    panel, _ = fit_panel(prompted(size, yaw), np.random.default_rng(0))
    assert min(agreement(panel, size, yaw).values()) > 0.9


@pytest.mark.parametrize(
    "eyes",
    [
        ([0.22, -0.73, 0.3], [1.01, -1.18, 0.5], [0.79, -1.11, 0.58], [-0.65, -0.87, 0.58]),
        ([-0.36, -1.13, 0.36], [0.81, -1.13, 0.88], [0.43, -0.91, 0.57], [-0.14, -1.12, 0.86]),
    ],
)
def test_the_seam_behind_the_panel_is_found_from_all_viewpoints(eyes):
    """From these viewpoints a seam at twice or five times the door's thickness explains the boxes nearly as well."""
    panel, _ = fit_panel(prompted(masks="right", eyes=eyes), np.random.default_rng(0))
    assert panel.low[2] == pytest.approx(DOOR[0, 1], abs=0.003)


@pytest.mark.parametrize("boxes", [DRAWER, UPRIGHT_LID], ids=["drawer", "lid"])
def test_parts_that_were_scanned_open_have_their_own_box(boxes):
    views = prompted(yaw=0.7, masks="right", eyes=OPEN_EYES, boxes=boxes)
    panel, misfits = fit_panel(views, np.random.default_rng(0))
    assert np.mean(misfits) < 0.08
    assert min(agreement(panel, yaw=0.7, boxes=boxes).values()) > 0.9


def test_an_open_door_has_its_own_box_and_the_table_before_it_stays_table():
    views = prompted(masks="right", eyes=OPEN_EYES, boxes=OPEN_CABINET)
    panel, misfits = fit_panel(views, np.random.default_rng(0))
    assert np.mean(misfits) < 0.08
    assert min(agreement(panel, boxes=OPEN_CABINET).values()) > 0.9
    around = np.random.default_rng(0).uniform([-0.1, -0.4, -0.01], [0.3, -0.1, 0.0], (500, 3))
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
    panel, _ = fit_panel(views, rng)
    assert min(agreement(panel).values()) > 0.88


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
        return float(np.mean(fit_panel(views, np.random.default_rng(0))[1]))
    except ReconstructionError:
        return np.inf


def test_a_box_that_shows_no_surface_is_refused():
    views = prompted()
    empty = np.full_like(views[1].points_world, np.nan)
    hidden = PromptedView(part=MOVING, camera=views[1].camera, points_world=empty, box=views[1].box, masks=())
    with pytest.raises(ReconstructionError, match="0 pixels of surface"):
        fit_panel([views[0], hidden, views[3]], np.random.default_rng(0))


def boxes_of(T_world_panel: np.ndarray) -> Panel:
    """A panel of 1 m before a body that stands out to the right and above."""
    return Panel(
        T_world_panel=T_world_panel,
        low=np.array([0.0, 0.0, -0.05]),
        high=np.array([1.0, 1.0, 0.1]),
        T_panel_body=transform(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3)),
        body_low=np.array([-0.2, 0.0, 0.0]),
        body_high=np.array([1.2, 0.8, 1.2]),
    )


def test_what_shows_through_a_front_is_the_front():
    panel = boxes_of(np.eye(4))
    inside = np.array([[[0.5, 0.5, -0.4]], [[1.1, 0.5, -0.4]], [[0.5, 0.5, -2.0]]])
    assert panel.labels(inside.reshape(-1, 3)).tolist() == [STATIC, STATIC, BACKGROUND]
    front = panel.labels_seen(inside, np.array([0.5, 0.5, 3.0]))
    assert front.ravel().tolist() == [MOVING, STATIC, BACKGROUND]
    behind = panel.labels_seen(inside, np.array([0.5, 0.5, -3.0]))
    assert behind.ravel().tolist() == [STATIC, STATIC, BACKGROUND]
    unseen = panel.labels_seen(np.full((1, 1, 3), np.nan), np.array([0.5, 0.5, 3.0]))
    assert unseen.item() == BACKGROUND


def test_the_body_has_some_thickness_but_not_below():
    panel = boxes_of(np.eye(4)).thicken_body(0.02)
    assert np.allclose(panel.body_low, [-0.22, -0.02, 0])
    assert np.allclose(panel.body_high, [1.22, 0.82, 1.22])


@pytest.mark.parametrize("chosen", range(UNKNOWNS))
def test_a_step_moves_one_unknown_and_back(chosen):
    panel = boxes_of(turned(0.3) @ transform(matrix_from_rotvec([0.2, 0.0, 0.0]), np.zeros(3)))
    step = 0.05 * np.eye(UNKNOWNS)[chosen]
    moved, names = panel.move(step), ("low", "high", "T_panel_body", "body_low", "body_high")
    changed = [name for name in names if not np.allclose(getattr(moved, name), getattr(panel, name))]
    assert len(changed) == 1
    assert (changed[0] == "T_panel_body") == (chosen == YAW)
    back = moved.move(-step)
    assert all(np.allclose(getattr(back, name), getattr(panel, name)) for name in names)


def test_boxes_without_a_size_are_impossible():
    panel = boxes_of(np.eye(4))
    assert panel.is_valid
    assert not panel.move(np.eye(UNKNOWNS)[4] * 0.06).is_valid
    assert not panel.move(np.eye(UNKNOWNS)[9] * -1.5).is_valid


def test_points_that_were_seen_to_move_make_the_panel_reach_them():
    """No box shows how far the handle stands out; the gripper held its end."""
    views = [view for view in prompted(masks="none", eyes=[[0.2, -1.5, 0.15]] * 4)]
    rng = np.random.default_rng(0)
    held = rng.uniform([0.1, -0.12, 0.1], [0.3, -0.02, 0.2], (300, 3))
    stands = rng.uniform([0.4, -0.12, 0.05], [0.5, 0.3, 0.3], (300, 3))
    points = apply(turned(0.0), np.concatenate([held, stands]))
    tracked = TrackedPoints(points=points, moves=np.arange(600) < 300, weights=np.ones(600))
    with_them, _ = fit_panel(views, np.random.default_rng(0), tracked)
    assert np.mean(with_them.labels(points[:300]) == MOVING) > 0.95
    assert np.mean(with_them.labels(points[300:]) == MOVING) < 0.02


def test_few_or_doubtful_odds_are_no_points():
    count = 40
    gaussians = gaussians_of(
        means=np.zeros((count, 3)), quats=np.tile([1.0, 0, 0, 0], (count, 1)), scales=np.full((count, 3), 0.01),
        opacities=np.ones(count), sh=np.zeros((count, 1, 3)),
    )  # fmt: skip
    odds = np.linspace(-2, 2, count)
    tracked = TrackedPoints.of(gaussians, odds)
    assert len(tracked.points) == np.sum(np.abs(odds) >= 1)
    assert tracked.moves.tolist() == (odds[np.abs(odds) >= 1] > 0).tolist()
    assert TrackedPoints.of(gaussians, np.zeros(count)).loss(boxes_of(np.eye(4))) == 0.0


def test_labels_move_with_the_panel():
    points = np.random.default_rng(5).uniform(-1, 1.5, (4000, 3))
    there = boxes_of(np.eye(4)).labels(points)
    assert set(there.tolist()) == {BACKGROUND, STATIC, MOVING}
    T = turned(1.1)
    assert np.array_equal(boxes_of(T).labels(apply(T, points)), there)


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
    T, size = find_panel_frame(points, np.array([[1.0, 0, 1]]) + 2 * np.array([normal]), rng)
    assert np.degrees(np.arccos(np.clip(T[:3, 2] @ want / np.linalg.norm(want), -1, 1))) < 1.0
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert 0.2 < size < 0.5
    assert abs((T[:3, 3] - [1, 0, 1]) @ T[:3, 2]) < 0.005
    turned_away, _ = find_panel_frame(points, np.array([[1.0, 0, 1]]) - 2 * np.array([normal]), rng)
    assert turned_away[:3, 2] @ T[:3, 2] < -0.99


def test_a_plane_is_found_among_few_points_of_which_samples_contain_one_twice() -> None:
    rng = np.random.default_rng(3)
    plane = np.column_stack([rng.uniform(-1, 1, (40, 2)), np.zeros(40)])
    others = rng.uniform([-1, -1, 0.2], [1, 1, 2.0], (20, 3))
    normal, origin, near = _find_plane(np.concatenate([plane, others]), 0.01, rng)
    assert abs(normal[2]) == pytest.approx(1.0)
    assert origin[2] == pytest.approx(0.0)
    assert len(near) == 40


# A drawer's front in the left half of a body, both facing +z.
PANEL = Panel(
    T_world_panel=np.eye(4), low=[-0.5, -0.5, -0.02], high=[0.0, 0.5, 0.05],
    T_panel_body=np.eye(4), body_low=[-0.5, -0.5, -0.5], body_high=[0.5, 0.5, 0.0],
)  # fmt: skip


def spread_gaussians(count: int, width: float, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.uniform([-0.4, -0.4, -0.015], [0.4, 0.4, -0.005], (count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=width * rng.uniform(0.1, 1.0, (count, 3)),
        opacities=rng.uniform(0.2, 0.9, count),
        sh=rng.uniform(-1, 1, (count, 1, 3)),
    )


def cut_all(gaussians: Gaussians) -> tuple:
    cut = cut_at_faces(gaussians, PANEL, np.ones(len(gaussians), bool))
    return cut, cut.apply(gaussians), cut.origins(len(gaussians))


def weights(gaussians: Gaussians) -> np.ndarray:
    return gaussians.opacities * gaussians.scales.astype(np.float64).prod(1)


def test_a_gaussian_across_a_seam_is_cut_and_one_beside_it_is_not():
    both = gaussians_of(
        means=[[0.01, 0, -0.01], [-0.2, 0, -0.01]], quats=[[1, 0, 0, 0]] * 2, scales=[[0.03, 0.02, 0.001]] * 2,
        opacities=[0.5, 0.5], sh=np.zeros((2, 1, 3)),
    )  # fmt: skip
    cut, pieces, origins = cut_all(both)
    assert list(cut.sources) == [0, 0]
    assert list(origins) == [1, 0, 0]
    assert sorted(PANEL.labels(pieces.means[1:])) == [STATIC, MOVING]


def test_pieces_have_the_moments_of_their_gaussian():
    """Weight, mean and covariance of all pieces together are those of what was cut."""
    gaussians = spread_gaussians(300, 0.05)
    cut, pieces, origins = cut_all(gaussians)
    assert len(cut.sources) > 50
    for index in np.unique(cut.sources):
        own = pieces.select(origins == index)
        shares = weights(own) / weights(gaussians)[index]
        assert shares.sum() == pytest.approx(1, abs=1e-4)
        mean = shares @ own.means
        assert mean == pytest.approx(gaussians.means[index], abs=1e-5)
        axes = matrix_from_quat(own.quats) * own.scales[:, None, :]
        apart = own.means - mean
        spread = np.einsum(
            "m,mij->ij", shares, axes @ axes.swapaxes(1, 2) + apart[:, :, None] * apart[:, None]
        )
        whole = matrix_from_quat(gaussians.quats[index]) * gaussians.scales[index]
        assert spread == pytest.approx(whole @ whole.T, abs=2e-6)


def test_pieces_keep_to_their_side():
    """Of a Gaussian cut in the middle, each half has a tenth of its weight beyond the face at most."""
    gaussians = spread_gaussians(500, 0.04)
    cut, pieces, _ = cut_all(gaussians)
    halves = pieces.select(slice(len(gaussians) - len(np.unique(cut.sources)), None))
    widths = np.linalg.norm(halves.scales * matrix_from_quat(halves.quats)[:, 0], axis=1)
    crossing = np.abs(halves.means[:, 0]) < widths
    beyond = norm.cdf(-np.abs(halves.means[:, 0]) / widths)
    assert np.mean(crossing) < 0.05
    assert np.median(beyond) < MIN_SHARE


def test_the_picture_stays():
    # Flat ones, as trained surfaces are, behind one another by 0.1 mm.
    count = 400
    rng = np.random.default_rng(1)
    flat = gaussians_of(
        means=np.c_[rng.uniform(-0.4, 0.4, (count, 2)), np.linspace(-0.03, -0.001, count)],
        quats=np.tile([1.0, 0, 0, 0], (count, 1)), scales=np.tile([0.05, 0.03, 0.0005], (count, 1)),
        opacities=np.full(count, 0.6), sh=rng.uniform(-1, 1, (count, 1, 3)),
    )  # fmt: skip
    _, pieces, _ = cut_all(flat)
    T_world_cam = np.diag([1.0, -1, -1, 1])
    T_world_cam[2, 3] = 1.5
    camera = Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240, T_world_cam=T_world_cam)
    before, after = (render(item, camera).rgb for item in (flat, pieces))
    assert len(pieces) > len(flat) + 20
    assert 10 * np.log10(1 / np.mean((before - after) ** 2)) > 33


def test_what_is_not_free_is_not_cut():
    gaussians = spread_gaussians(100, 0.05)
    assert len(cut_at_faces(gaussians, PANEL, np.zeros(100, bool)).sources) == 0


def test_no_cut_changes_nothing():
    gaussians = spread_gaussians(20, 0.05)
    cut = no_cut(gaussians)
    assert np.array_equal(cut.origins(20), np.arange(20))
    assert np.array_equal(cut.apply(gaussians).means, gaussians.means)
