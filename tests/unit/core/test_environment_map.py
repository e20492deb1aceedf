"""Laws of light from all around."""

import numpy as np
import pytest

from aomgen.core.environment_map import EnvironmentMap, map_directions
from aomgen.core.light import Light, light_from_harmonics
from aomgen.core.sh import sh_basis
from aomgen.core.transforms import matrix_from_rotvec

HEIGHT, WIDTH = 64, 128
NORMALS = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.0, 0.8], [0.0, -0.8, 0.6]]])


def map_of(radiance) -> EnvironmentMap:
    return EnvironmentMap(radiance_linear=np.broadcast_to(radiance, (HEIGHT, WIDTH, 3)))


def harmonics() -> Light:
    sh = np.random.default_rng(0).normal(0, 0.2, (9, 3))
    sh[0] = 3.0
    return light_from_harmonics(sh)


def rendered(light: Light) -> EnvironmentMap:
    return map_of(sh_basis(map_directions(HEIGHT, WIDTH), 2) @ light.radiance_sh)


def test_even_light_gives_pi_times_its_radiance() -> None:
    even = map_of([0.5, 1.0, 2.0])
    assert even.solid_angles.sum() * WIDTH == pytest.approx(4 * np.pi, abs=1e-12)
    answer = even.light().irradiance(NORMALS)
    np.testing.assert_allclose(answer, np.tile([0.5, 1.0, 2.0], (len(NORMALS), 1)), rtol=1e-3)


@pytest.mark.parametrize("sun", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.48, 0.64), (-0.6, 0.0, -0.8)])
def test_a_small_sun_has_the_harmonics_of_its_direction(sun: tuple[float, float, float]) -> None:
    around = map_of(0)
    nearness = around.directions @ np.array(sun)
    row, column = np.unravel_index(nearness.argmax(), nearness.shape)
    assert nearness[row, column] > np.cos(np.pi / HEIGHT)
    radiance = np.zeros((HEIGHT, WIDTH, 3))
    radiance[row, column] = np.array([3.0, 2.0, 1.0]) / around.solid_angles[row]
    want = sh_basis(around.directions[row, column], 2)[:, None] * [3.0, 2.0, 1.0]
    np.testing.assert_allclose(map_of(radiance).light().radiance_sh, want, rtol=1e-5, atol=1e-6)


def test_harmonics_come_back_from_the_map_drawn_of_them() -> None:
    np.testing.assert_allclose(rendered(harmonics()).light().radiance_sh, harmonics().radiance_sh, atol=3e-3)


@pytest.mark.parametrize("angle_deg", [90.0, 33.0, -200.0])
def test_a_turned_map_has_the_turned_light(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    turned = rendered(harmonics()).turn(angle).light()
    # What a body turned the other way sees.
    want = harmonics().view_from(matrix_from_rotvec(np.array([0, 0, -angle])))
    np.testing.assert_allclose(turned.radiance_sh, want, atol=3e-3)
