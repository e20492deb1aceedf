import numpy as np
import pytest

from aomgen.conventions import illuminate_srgb, linear_from_srgb, srgb_from_linear
from aomgen.core.gaussians import gaussians_of
from aomgen.lighting.table_shadow import shadow_gain
from aomgen.twin.plan_view import PlanView
from aomgen.twin.support import Support

CELL = 0.004
TABLE_SRGB = np.array([0.7, 0.55, 0.4])


def box(half, height):
    """A dense block of Gaussians on the plane, half as wide as it is high."""
    places = np.arange(-half, half + 1e-6, 0.01)
    grid = np.stack(np.meshgrid(places, places, np.arange(0.005, height, 0.01)), -1).reshape(-1, 3)
    count = len(grid)
    return gaussians_of(
        means=grid,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.006),
        opacities=np.full(count, 0.95),
        sh=np.zeros((count, 1, 3)),
    )


def lit_share(xy, half, height, directions, light):
    """Share of the light that reaches places of the plane past a box, by rays."""
    total = np.zeros(xy.shape[:2])
    for way, weight in zip(directions, light, strict=True):
        blocked = np.zeros(xy.shape[:2], bool)
        for z in np.linspace(0.001, height, 60):
            there = xy + way[:2] / way[2] * z
            blocked |= (np.abs(there) < half).all(-1)
        total += weight * ~blocked
    return total / light.sum()


LOW, HIGH = np.full(2, -0.3), np.full(2, 0.3)
SUPPORT = Support(T_world_plane=np.eye(4), low=LOW, high=HIGH, reach_low=LOW, reach_high=HIGH, top=0.15)
PLAN = PlanView(support=SUPPORT, low=LOW, high=HIGH, cell=CELL)


@pytest.fixture(scope="module")
def scene():
    half, height = 0.08, 0.15
    cells = np.arange(-0.3, 0.3, CELL) + CELL / 2
    xy = np.stack(np.meshgrid(cells, cells), -1)
    # A lamp and an even sky.
    rng = np.random.default_rng(0)
    sky = rng.normal(size=(60, 3))
    sky[:, 2] = np.abs(sky[:, 2]) + 0.2
    lamp = np.array([0.5, 0.3, 0.8]) + 0.05 * rng.normal(size=(20, 3))
    directions = np.concatenate([sky, lamp])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    light = directions[:, 2] * np.repeat([1.0, 3.0], [60, 20])
    return half, height, xy, lit_share(xy, half, height, directions, light)


def test_a_shadow_of_sky_and_lamp_is_taken_away(scene):
    half, height, xy, share = scene
    picture = srgb_from_linear(linear_from_srgb(TABLE_SRGB) * share[..., None])
    known = np.abs(xy).max(-1) > half + 0.012
    gain = shadow_gain(box(half, height), PLAN, picture, known)
    left, before = np.abs(illuminate_srgb(picture, gain) - TABLE_SRGB), np.abs(picture - TABLE_SRGB)
    deep, shadowed = known & (share < 0.5), known & (share < 0.95)
    assert deep.sum() > 500
    assert left[deep].mean() < 0.25 * before[deep].mean()
    assert left[shadowed].mean() < 0.65 * before[shadowed].mean()
    lift = illuminate_srgb(picture, gain) / picture
    assert np.abs(lift - 1)[known & (share > 0.99)].mean() < 0.02


def test_a_table_without_a_shadow_stays_as_it_is(scene):
    half, height, xy, _ = scene
    slope = 1 + 0.3 * xy[..., :1]
    picture = srgb_from_linear(linear_from_srgb(TABLE_SRGB) * slope)
    known = np.abs(xy).max(-1) > half + 0.012
    gain = shadow_gain(box(half, height), PLAN, picture, known)
    far = np.abs(xy).max(-1) > half + 0.08
    assert (illuminate_srgb(picture, gain) / picture)[far].max() < 1.1


def test_of_a_table_that_nobody_saw_nothing_is_said(scene):
    half, height, xy, _ = scene
    unknown = np.zeros(xy.shape[:2], bool)
    gain = shadow_gain(box(half, height), PLAN, np.zeros((*xy.shape[:2], 3)), unknown)
    assert (gain == 1).all()
