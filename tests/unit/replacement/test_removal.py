from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.transforms import apply
from aomgen.errors import ReconstructionError
from aomgen.lighting.shadowed_twin import render_state
from aomgen.replacement.removal import FADE, _hardly_seen, clear_object, renew_surface
from aomgen.replacement.table_texture import Photograph, inpaint
from aomgen.splatting.rasterizer import render
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import Support
from aomgen.twin.twin import pose_twin

TABLE_SRGB = (0.6, 0.45, 0.3)


@pytest.fixture(scope="module")
def photographs(toy_scene):
    views = []
    for angle in np.linspace(-2.8, 2.2, 10):
        eye = (0.6 + 1.1 * np.cos(angle), -0.05 + 1.1 * np.sin(angle), 0.9)
        pose = look_at(eye, (0.6, -0.05, 0))
        camera = Camera(fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=pose)
        drawn = render_state(toy_scene.twin, toy_scene.robot, toy_scene.twin.scan_state, camera)
        views.append(Photograph(camera=camera, image_srgb=(255 * np.clip(drawn.rgb, 0, 1)).astype(np.uint8)))
    return views


def patched(seed):
    return partial(inpaint, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def cleared(toy_scene, photographs):
    return clear_object(toy_scene.twin, toy_scene.robot, photographs, patched(0))


def test_the_plane_is_found_under_the_object(cleared):
    T = cleared.support.T_world_plane
    assert abs(T[2, 3]) < 0.003
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=0.01)


@pytest.mark.parametrize("eye", [(-0.3, -0.9, 0.7), (0.1, 0.9, 0.8), (0.2, -0.2, 1.2)])
def test_no_hole_and_no_trace_of_the_object_is_left(toy_scene, cleared, eye):
    camera = Camera(
        fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=look_at(eye, (0.65, -0.1, 0))
    )
    before = render_state(toy_scene.twin, toy_scene.robot, toy_scene.twin.scan_state, camera, with_ids=True)
    after = render_state(cleared.twin, toy_scene.robot, toy_scene.twin.scan_state, camera, with_ids=True)
    assert before.max_id is not None
    was_object = np.isin(toy_scene.twin.labels[np.maximum(before.max_id, 0)], (2, 3)) & (before.max_id >= 0)
    rays = camera.directions()
    hit = camera.center + rays * (-camera.center[2] / np.minimum(rays[..., 2], -1e-6))[..., None]
    on_table = was_object & (hit[..., 0] < 1.15) & (np.abs(hit[..., 1] + 0.05) < 0.8) & (rays[..., 2] < 0)
    assert on_table.sum() > 500
    assert after.alpha[on_table].min() > 0.9
    assert np.abs(after.rgb[on_table] - TABLE_SRGB).max() < 0.12
    elsewhere = (before.max_id >= 0) & ~was_object
    assert np.abs(after.rgb - before.rgb)[elsewhere].mean() < 0.02


def test_what_no_photograph_shows_behind_the_object_is_taken_away(toy_scene, photographs, cleared):
    """A dark thing that only the object's absence would show; another one beside it is seen and stays."""
    twin, T = toy_scene.twin, toy_scene.twin.T_world_object
    points = np.random.default_rng(0).normal(0, 0.01, (200, 3))
    hidden = apply(T, points + [0.0, 0.05, 0.1])
    seen = points + [0.3, 0.4, 0.15]
    count = len(twin.gaussians)
    more = [
        gaussians_of(
            means=means,
            quats=np.tile([1.0, 0, 0, 0], (200, 1)),
            scales=np.full((200, 3), 0.01),
            opacities=np.full(200, 0.9),
            sh=np.full((200, 4, 3), 0.0),
        )
        for means in (hidden, seen)
    ]
    clutter = twin.extend(more[0], 0, BACKGROUND).extend(more[1], 0, BACKGROUND)
    world = pose_twin(clutter, toy_scene.robot, clutter.scan_state)
    chosen = _hardly_seen(world, np.isin(clutter.labels, (STATIC, MOVING)), photographs)
    assert chosen[count : count + 200].mean() > 0.95
    assert not chosen[count + 200 :].any()
    assert not chosen[np.isin(clutter.labels, (STATIC, MOVING))].any()


def test_labels_and_robot_after_removal(toy_scene, cleared):
    assert set(np.unique(cleared.twin.labels)) == {BACKGROUND, ROBOT}
    assert (cleared.twin.labels == ROBOT).sum() == (toy_scene.labels == ROBOT).sum()


def test_removal_is_the_same_each_time(toy_scene, photographs, cleared):
    again = clear_object(toy_scene.twin, toy_scene.robot, photographs, patched(0))
    np.testing.assert_array_equal(again.twin.gaussians.sh, cleared.twin.gaussians.sh)


def test_an_object_in_the_air_has_no_support(toy_scene, photographs):
    floating = toy_scene.twin.select(
        (toy_scene.labels != BACKGROUND) | (toy_scene.gaussians.means[:, 2] > 0.05)
    )
    with pytest.raises(ReconstructionError, match="lie flat"):
        clear_object(floating, toy_scene.robot, photographs, patched(0))


def test_the_scan_itself_is_not_changed(toy_scene, photographs):
    before = toy_scene.twin.gaussians.sh.copy()
    clear_object(replace(toy_scene.twin), toy_scene.robot, photographs, patched(3))
    np.testing.assert_array_equal(toy_scene.twin.gaussians.sh, before)


COLOR = (0.5, 0.4, 0.3)
HOLE_M = 0.1
SUPPORT = Support(
    T_world_plane=np.eye(4),
    low=np.full(2, -HOLE_M),
    high=np.full(2, HOLE_M),
    reach_low=np.full(2, -HOLE_M),
    reach_high=np.full(2, HOLE_M),
    top=0.2,
)
PLAN = PlanView(support=SUPPORT, low=np.full(2, -0.4), high=np.full(2, 0.4), cell=0.004)


def table() -> Gaussians:
    """It looks brighter from +x, more so at its +y side, as under a window."""
    xy = np.stack(np.meshgrid(*[np.arange(-0.5, 0.5, 0.006)] * 2), -1).reshape(-1, 2)
    sh = np.zeros((len(xy), 4, 3))
    sh[:, 0] = (np.asarray(COLOR) - 0.5) / SH_C0
    sh[:, 3] = (-0.2 * (0.5 + xy[:, 1]))[:, None]
    return gaussians_of(
        means=np.column_stack([xy, np.zeros(len(xy))]),
        quats=np.tile([1.0, 0, 0, 0], (len(xy), 1)),
        scales=np.tile([0.005, 0.005, 0.0005], (len(xy), 1)),
        opacities=np.full(len(xy), 0.98),
        sh=sh,
    )


def in_hole(xy: NDArray[np.floating]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(xy).max(-1) < HOLE_M)


def renewed() -> tuple[Gaussians, Gaussians]:
    """The whole table, and the table without what lies in the hole, with new surface there."""
    whole = table()
    holed = whole.select(~in_hole(whole.means[:, :2]))
    new = in_hole(PLAN.xy)
    texture = np.broadcast_to(COLOR, (*PLAN.shape, 3))
    area = np.ones(PLAN.shape, bool)
    fill, kept = renew_surface(holed, np.ones(len(holed), bool), PLAN, texture, ~new, new, new, area)
    opacities = holed.opacities * kept.astype(np.float32)
    faded = gaussians_of(
        means=holed.means, quats=holed.quats, scales=holed.scales, opacities=opacities, sh=holed.sh
    )
    return whole, concatenate([faded.select(kept > 0), fill.with_sh_degree(1)])


@pytest.mark.parametrize("eye", [(0.8, 0.1, 0.6), (-0.8, 0.2, 0.5), (0.1, -0.9, 0.7), (0, 0.1, 1.2)])
def test_no_border_shows_from_anywhere(eye: tuple[float, float, float]) -> None:
    camera = Camera(fx=200, fy=200, cx=80, cy=60, width=160, height=120, T_world_cam=look_at(eye, (0, 0, 0)))
    whole, closed = (render(scene, camera) for scene in renewed())
    inside = whole.alpha > 0.99
    assert inside.sum() > 5000
    assert closed.alpha[inside].min() > 0.97
    assert np.abs(closed.rgb - whole.rgb)[inside].max() < 0.03


def test_things_on_the_surface_are_neither_faded_nor_covered() -> None:
    whole = table()
    new = in_hole(PLAN.xy)
    sheet = (PLAN.xy[..., 0] > HOLE_M + 0.01) & (PLAN.xy[..., 0] < HOLE_M + FADE)
    known, area = ~new & ~sheet, ~sheet
    texture = np.broadcast_to(COLOR, (*PLAN.shape, 3))
    fill, kept = renew_surface(whole, np.ones(len(whole), bool), PLAN, texture, known, new, new, area)
    on_sheet = PLAN.lookup(sheet, whole, False)
    assert on_sheet.sum() > 100
    assert (kept[on_sheet] == 1).all()
    assert not PLAN.lookup(sheet, fill, False).any()
    assert (kept[in_hole(whole.means[:, :2])] < 1e-9).all()
