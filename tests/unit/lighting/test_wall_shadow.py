"""What stands around a removed object gets back the light that it kept from it, no more, and only where it did."""

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.light import DirectionalLight, Light, hemisphere_light, light_from_harmonics
from aomgen.core.transforms import quat_from_matrix, transform
from aomgen.lighting.wall_shadow import REACH_M, cast_wall_shadow

RNG = np.random.default_rng(0)
EYES = np.array([[0.0, -1.5, 1.0], [0.5, -1.5, 1.2]])
# Far below: nothing here is on it.
PLANE = transform(np.eye(3), [0.0, 0.0, -9.0])


def passed(
    wall: Gaussians, box: Gaussians, light: Light, lamp: DirectionalLight | None = None, T=None
) -> np.ndarray:
    """Share of the light that each of the wall's Gaussians gets past the box."""
    T = np.eye(4) if T is None else T
    scene, body, eyes = wall.transform(T), box.transform(T), EYES + T[:3, 3]
    return cast_wall_shadow(scene, body, light, lamp, eyes, PLANE, len(wall))[:, 0]


def sheet(axis: int, at: float, low: tuple[float, float], high: tuple[float, float]) -> Gaussians:
    """A square of flat Gaussians across an axis."""
    means = np.insert(RNG.uniform(low, high, (4000, 2)), axis, at, axis=1)
    scales = np.full((len(means), 3), 0.01)
    scales[:, axis] = 0.001
    return gaussians_of(
        means=means,
        quats=np.tile(quat_from_matrix(np.eye(3)), (len(means), 1)),
        scales=scales,
        opacities=np.full(len(means), 0.9),
        sh=np.zeros((len(means), 1, 3)),
    )


@pytest.fixture(scope="module")
def wall() -> Gaussians:
    """Behind the box, a meter wide on either side, and high."""
    return sheet(1, 0.4, (-1.0, 0.0), (1.0, 0.8))


@pytest.fixture(scope="module")
def box() -> Gaussians:
    """40 cm wide, 30 cm high, its back 10 cm before the wall; filled, so that no ray slips through."""
    means = RNG.uniform((-0.2, 0.0, 0.0), (0.2, 0.3, 0.3), (20_000, 3))
    return gaussians_of(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        scales=np.full((len(means), 3), 0.01),
        opacities=np.full(len(means), 0.9),
        sh=np.zeros((len(means), 1, 3)),
    )


def test_a_wall_is_dark_behind_the_box_and_not_far_from_it(wall, box):
    share = passed(wall, box, hemisphere_light(np.ones(3), np.full(3, 0.4)))
    x, _, z = wall.means.T
    assert ((share > 0) & (share <= 1)).all()
    assert share[(np.abs(x) < 0.1) & (z < 0.15)].mean() < 0.7
    assert share[np.abs(x) > 0.9].min() > 0.93
    assert (share[np.abs(x) > REACH_M + 0.2] == 1).all()


def test_light_from_one_side_throws_the_shadow_to_the_other(wall, box):
    radiance = np.zeros((9, 3))
    radiance[0], radiance[3] = 1.0, 0.5
    mirrored = np.where(np.arange(9) == 3, -1, 1)[:, None] * radiance
    x, _, z = wall.means.T
    beside = (np.abs(x) > 0.22) & (np.abs(x) < 0.4) & (z < 0.3)
    first, second = (passed(wall, box, light_from_harmonics(sh)) for sh in (radiance, mirrored))
    sides = [[share[beside & (sign * x > 0)].mean() for sign in (1, -1)] for share in (first, second)]
    assert abs(sides[0][0] - sides[0][1]) > 0.05
    np.testing.assert_allclose(sides[0], sides[1][::-1], atol=0.03)


def test_what_the_lamp_cannot_reach_lacks_its_whole_share(wall, box):
    even = hemisphere_light(np.ones(3), np.ones(3))
    lamp = DirectionalLight(
        directions=np.array([[0.0, -0.8, 0.6]]), T_world_plane=np.eye(4), share=np.full(3, 1 - 0.5**2.2)
    )
    with_lamp, without = (passed(wall, box, even, item) for item in (lamp, None))
    x, _, z = wall.means.T
    # The box's top edge hides the wall up to its own height less 0.1 * 0.6 / 0.8.
    hidden, lit = (np.abs(x) < 0.15) & (z < 0.1), (np.abs(x) < 0.15) & (z > 0.4)
    assert with_lamp[hidden].mean() < without[hidden].mean() - 0.1
    assert with_lamp[lit].mean() > without[lit].mean() - 0.01


def test_the_shadow_moves_with_the_scene(wall, box):
    light = hemisphere_light(np.ones(3), np.full(3, 0.4))
    there = passed(wall, box, light, T=transform(np.eye(3), [3.0, -2.0, 0.5]))
    assert np.median(np.abs(passed(wall, box, light) - there)) < 0.01


def test_a_few_places_tell_what_all_do(wall, box):
    light = hemisphere_light(np.ones(3), np.full(3, 0.4))
    few = cast_wall_shadow(wall, box, light, None, EYES, PLANE, 400)[:, 0]
    assert np.abs(few - passed(wall, box, light)).mean() < 0.02


def test_the_table_and_what_is_far_get_no_shadow(wall, box):
    light = hemisphere_light(np.ones(3), np.ones(3))
    far = wall.transform(transform(np.eye(3), [0.0, 5.0, 0.0]))
    assert (cast_wall_shadow(far, box, light, None, EYES, PLANE, 4000) == 1).all()
    table = sheet(2, 0.0, (-0.5, -0.5), (0.5, 0.5))
    assert (cast_wall_shadow(table, box, light, None, EYES, np.eye(4), 4000) == 1).all()
