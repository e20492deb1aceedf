import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, gaussians_of
from aomgen.core.sh import sh_basis
from aomgen.replacement.table_texture import Photograph, continue_smoothly, inpaint, photograph_surface
from aomgen.splatting.rasterizer import render

LEVEL = np.eye(4)
GLOSS = np.array([[0.0, 0, 0], [0.1, 0.05, 0], [0, 0, 0], [0, -0.05, 0.1]])


def flat(low, high, z, color, gloss):
    xy = np.stack(np.meshgrid(np.arange(low, high, 0.01), np.arange(low, high, 0.01)), -1).reshape(-1, 2)
    sh = np.tile(gloss, (len(xy), 1, 1))
    sh[:, 0] += (np.asarray(color) - 0.5) / SH_C0
    return gaussians_of(
        means=np.column_stack([xy, np.full(len(xy), z)]),
        quats=np.tile([1.0, 0, 0, 0], (len(xy), 1)),
        scales=np.tile([0.008, 0.008, 0.001], (len(xy), 1)),
        opacities=np.full(len(xy), 0.98),
        sh=sh,
    )


def photographs(world):
    views = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        eye = (0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.8)
        camera = Camera(
            fx=150, fy=150, cx=80, cy=60, width=160, height=120, T_world_cam=look_at(eye, (0, 0, 0))
        )
        image = np.rint(255 * np.clip(render(world, camera).rgb, 0, 1)).astype(np.uint8)
        views.append(Photograph(camera=camera, image_srgb=image))
    return views


@pytest.fixture(scope="module")
def table():
    return flat(-0.6, 0.6, 0.0, (0.5, 0.4, 0.3), GLOSS)


def cells(reach=0.1):
    places = np.arange(-reach, reach, 0.01)
    return np.stack(np.meshgrid(places, places), -1)


def test_colors_of_a_surface_are_what_its_photographs_show_in_the_middle(table):
    views = photographs(table)
    colors, seen = photograph_surface(table, np.ones(len(table), bool), views, LEVEL, cells())
    assert seen.all()
    shown = []
    for view in views:
        ways = np.concatenate([cells(), np.zeros((*cells().shape[:2], 1))], -1) - view.camera.center
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        shown.append((0.5, 0.4, 0.3) + np.einsum("hwk,kc->hwc", sh_basis(ways, 1), GLOSS))
    assert np.abs(colors - np.median(shown, 0)).max() < 0.015


def test_where_views_show_different_things_nothing_is_known(table):
    """A mirror image lies elsewhere in every view: here a strip that is brighter from view to view."""
    views, strip = [], np.abs(table.means[:, 0]) < 0.03
    for number in range(len(photographs(table))):
        sh = table.sh.copy()
        sh[strip, 0] += 0.4 * number - 2.2
        views.append(photographs(table.with_sh(sh))[number])
    _, seen = photograph_surface(table, np.ones(len(table), bool), views, LEVEL, cells(0.15))
    across = np.abs(cells(0.15)[..., 0])
    assert not seen[across < 0.02].any()
    assert seen[across > 0.08].all()


def test_what_stands_on_the_surface_is_not_taken_for_it(table):
    lid = flat(-0.05, 0.05, 0.03, (1.0, 0.0, 0.0), np.zeros((4, 3)))
    world = gaussians_of(
        **{name: np.concatenate([getattr(table, name), getattr(lid, name)]) for name in ("means", "quats", "scales", "opacities", "sh")}
    )  # fmt: skip
    scene = np.arange(len(world)) < len(table)
    colors, seen = photograph_surface(world, scene, photographs(world), LEVEL, cells(0.15))
    middle = np.abs(cells(0.15)).max(-1) < 0.01
    assert not seen[middle].any()
    assert seen.mean() > 0.5
    assert (colors[seen][:, 0] < 0.65).all()


def test_one_view_is_not_enough(table):
    _, seen = photograph_surface(table, np.ones(len(table), bool), photographs(table)[:1], LEVEL, cells())
    assert not seen.any()


def test_inpainting_continues_color_and_texture():
    rng = np.random.default_rng(0)
    rows = np.arange(120)[:, None, None]
    image = 0.5 + 0.001 * rows + 0.08 * np.sin(np.arange(140) * 1.1)[None, :, None] * np.ones((120, 1, 3))
    known = np.ones((120, 140), bool)
    known[40:80, 50:100] = False
    result = inpaint(np.where(known[..., None], image, 0.0), known, rng)
    np.testing.assert_array_equal(result[known], image[known])
    filled = result[40:80, 50:100]
    assert np.abs(filled.mean(1) - image[40:80, 50:100].mean(1)).max() < 0.03
    assert filled.std(1).mean() > 0.6 * image[40:80, 50:100].std(1).mean()


def test_inpainting_nothing_gives_grey():
    assert (inpaint(np.zeros((40, 40, 3)), np.zeros((40, 40), bool), np.random.default_rng(0)) == 0.5).all()


def test_a_slope_goes_on_through_a_hole():
    slope = np.repeat(np.linspace(0.2, 0.8, 160)[None, :, None], 120, 0) * np.ones(3)
    known = np.ones((120, 160), bool)
    known[40:80, 60:100] = False
    smooth = continue_smoothly(np.where(known[..., None], slope, 0.0), known)
    assert np.abs(smooth - slope)[40:80, 60:100].max() < 0.04, "within a sixth of the slope"
