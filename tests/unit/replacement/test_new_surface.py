"""New surface in a hole of a trained one, which nobody sees."""

import numpy as np
import pytest
from numpy.typing import NDArray

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.replacement.new_surface import FADE, renew_surface
from aomgen.splatting.rasterizer import render
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import Support

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
