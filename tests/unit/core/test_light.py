"""Light from everywhere and light from one side, against what they are made of."""

import numpy as np
import pytest

from aomgen.core.light import (
    DirectionalLight,
    Light,
    hemisphere_light,
    light_from_harmonics,
    spread_directions,
)
from aomgen.core.transforms import matrix_from_rotvec

UP = np.array([0.0, 0.0, 1.0])


def lamp_of(share: float, width: float = 0.0) -> DirectionalLight:
    directions = spread_directions(np.array([0.6, 0.0, 0.8]), width)
    return DirectionalLight(directions=directions, share=np.full(3, share), T_world_plane=np.eye(4))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_surface_keeps_what_is_not_the_lamp_s(share):
    light = hemisphere_light((0.9, 0.8, 0.7), (0.3, 0.2, 0.1))
    rest, own = lamp_of(share, 0.1).split(light)
    total = light.irradiance(UP[None])
    np.testing.assert_allclose(rest.irradiance(UP[None]), (1 - share) * total, atol=1e-12)
    np.testing.assert_allclose(own.irradiance(UP[None]), share * total, atol=1e-12)
    assert (rest.radiance >= 0).all()


def test_a_lamp_alone_leaves_nothing():
    lamp = lamp_of(1 - 1e-12)
    alone = Light(directions=lamp.directions, radiance=np.array([[1.0, 0.5, 0.2]]))
    np.testing.assert_allclose(lamp.split(alone)[0].radiance_sh, 0, atol=1e-9)


def test_harmonics_come_back_and_turn_along():
    sh, R = np.random.default_rng(0).normal(size=(9, 3)), matrix_from_rotvec([0.3, -0.5, 0.8])
    light = light_from_harmonics(sh)
    np.testing.assert_allclose(light.radiance_sh, sh, atol=1e-12)
    np.testing.assert_allclose(light.turn(R).view_from(R), sh, atol=1e-12)
