"""Light without a lamp, against what it is made of."""

import numpy as np
import pytest

from aomgen.core.light import Light, hemisphere_light
from aomgen.core.sh import sh_basis

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_surface_keeps_what_is_not_the_lamp_s(share):
    light = hemisphere_light((0.9, 0.8, 0.7), (0.3, 0.2, 0.1))
    rest = light.without(np.array([0.6, 0.0, 0.8]), UP, share)
    want = (1 - share) * light.irradiance(UP[None])
    np.testing.assert_allclose(rest.irradiance(UP[None]), np.maximum(want, 0), atol=1e-12)


def test_a_lamp_alone_leaves_nothing():
    way = np.array([0.48, -0.6, 0.64])
    alone = Light(radiance_sh=sh_basis(way[None], 2).T * [1.0, 0.5, 0.2])
    np.testing.assert_allclose(alone.without(way, UP, 1.0).radiance_sh, 0, atol=1e-12)
