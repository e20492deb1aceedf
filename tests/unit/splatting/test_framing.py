"""The camera that is chosen sees the content, upright, whatever the frame and unit."""

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians, concatenate, gaussians_of
from aomgen.core.transforms import matrix_from_rotvec, similarity
from aomgen.splatting.framing import content, framing_camera


def ball(count: int = 2000, seed: int = 0) -> Gaussians:
    """Points in the unit ball around (5, 6, 7)."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return gaussians_of(
        means=directions * rng.uniform(0, 1, (count, 1)) ** (1 / 3) + [5, 6, 7],
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.02),
        opacities=np.full(count, 0.8),
        sh=np.zeros((count, 1, 3)),
    )


def with_floaters(g: Gaussians) -> Gaussians:
    """Faint Gaussians far away, one as large as the scene, and broken ones."""
    rng = np.random.default_rng(1)
    means, scales, opacities = g.means.copy(), g.scales.copy(), g.opacities.copy()
    means[:200] = rng.normal(0, 500, (200, 3))
    opacities[:200] = 0.01
    scales[200] = 1000
    means[200] = 300
    means[201:205, 0] = np.nan
    scales[205] = np.inf
    return gaussians_of(means=means, quats=g.quats, scales=scales, opacities=opacities, sh=g.sh)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_everything_is_in_view(scale: float) -> None:
    g = ball().transform(similarity(scale, matrix_from_rotvec(np.array([0.3, 1, 2])), (1, 2, 3)))
    for angles in [(0, 0), (130, 40), (250, -89), (0, 90)]:
        camera = framing_camera(g, (80, 60), up=(0, 0.1, 1), angles_deg=angles)
        pixels, depths = camera.project(g.means)
        assert (depths > 0).all()
        assert (np.abs(pixels - [40, 30]) < [40, 32]).all()
        assert np.abs(pixels - [40, 30]).max() > 20


def test_up_is_up() -> None:
    for up in ([0, 0, 1.0], [0, -1, 0], [3, 2, 1]):
        camera = framing_camera(ball(), (64, 64), up=up, angles_deg=(77, 20))
        pixels, _ = camera.project(np.array([[5, 6, 7], np.array([5, 6, 7]) + 0.3 * np.array(up)]))
        assert pixels[1, 1] < pixels[0, 1] - 1
        assert abs(pixels[1, 0] - pixels[0, 0]) < 0.5


def test_azimuth_turns_and_zoom_goes_nearer() -> None:
    def eye(**options) -> np.ndarray:
        return framing_camera(ball(), (64, 64), up=(0, 0, 1), **options).center - [5, 6, 7]

    np.testing.assert_allclose(eye(angles_deg=(0, 0)), -eye(angles_deg=(180, 0)), atol=0.1)
    assert np.linalg.norm(eye(zoom=2)) < 0.55 * np.linalg.norm(eye())


def test_floaters_do_not_push_the_camera_away() -> None:
    center, radius = content(with_floaters(ball()))
    np.testing.assert_allclose(center, [5, 6, 7], atol=0.1)
    assert 0.8 < radius < 1.5


def test_nothing_to_see() -> None:
    g = ball(3)
    faint = gaussians_of(means=g.means, quats=g.quats, scales=g.scales, opacities=np.zeros(3), sh=g.sh)
    for nothing in (g.select(np.zeros(3, bool)), faint):
        with pytest.raises(ValueError, match="visible"):
            framing_camera(nothing, (64, 64))
    with pytest.raises(ValueError, match="length zero"):
        framing_camera(g, (64, 64), up=(0, 0, 0))


def test_walls_do_not_stand_in_the_way() -> None:
    """A room recorded from inside is seen from inside; without its walls, the ball from outside."""
    rng = np.random.default_rng(2)
    walls = rng.uniform(-4, 4, (3000, 3))
    axis = rng.integers(0, 3, 3000)
    walls[np.arange(3000), axis] = rng.choice([-4, 4], 3000)
    room = gaussians_of(
        means=walls + [5, 6, 7],
        quats=np.tile([1.0, 0, 0, 0], (3000, 1)),
        scales=np.full((3000, 3), 0.2),
        opacities=np.full(3000, 0.9),
        sh=np.zeros((3000, 1, 3)),
    )
    inside = framing_camera(concatenate([ball(6000), room]), (64, 48), up=(0, 0, 1))
    assert np.abs(inside.center - [5, 6, 7]).max() < 4
    assert np.linalg.norm(inside.center - [5, 6, 7]) > 1
