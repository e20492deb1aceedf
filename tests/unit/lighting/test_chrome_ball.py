"""Light that is read off balls, drawn analytically in known light."""

import numpy as np
import pytest

from aomgen.conventions import srgb_from_linear
from aomgen.core.camera import Camera, look_at
from aomgen.core.environment_map import EnvironmentMap, map_directions
from aomgen.lighting.chrome_ball import merge_exposures, unwrap_ball

AXES = np.concatenate([np.eye(3), -np.eye(3)])
EXPOSURES = (0.0, -2.5, -5.0)
SIDE = 256


def camera_of_ball(eye, distances: float) -> Camera:
    """A square picture of a ball of radius 1 that fills it, from a distance."""
    focal = SIDE / 2 * np.sqrt(distances**2 - 1)
    T = look_at(np.array(eye), np.zeros(3))
    half = SIDE / 2
    return Camera(fx=focal, fy=focal, cx=half, cy=half, width=SIDE, height=SIDE, T_world_cam=T)


def room(directions: np.ndarray, lamp: float) -> np.ndarray:
    """Radiance of a colored room with a round lamp, 8 degrees about its middle."""
    x, y, z = np.moveaxis(directions, -1, 0)
    radiance = np.stack([0.4 + 0.2 * x, 0.4 + 0.2 * y, 0.4 + 0.2 * z], -1)
    radiance[directions @ [0.48, 0.36, 0.8] > np.cos(np.radians(8))] = lamp
    return radiance


def ball(camera: Camera, lamp: float) -> np.ndarray:
    """The ball of radius 1 at the origin, by tracing rays."""
    rays = camera.directions() / np.linalg.norm(camera.directions(), axis=-1, keepdims=True)
    along = rays @ -camera.center
    under_root = along**2 - camera.center @ camera.center + 1
    normals = camera.center + (along - np.sqrt(np.maximum(under_root, 0)))[..., None] * rays
    mirrored = rays - 2 * (rays * normals).sum(-1, keepdims=True) * normals
    return np.where(under_root[..., None] > 0, room(mirrored, lamp), 0)


def irradiance(lamp: float) -> np.ndarray:
    around = EnvironmentMap(radiance_linear=room(map_directions(512, 1024), lamp))
    return around.light().irradiance(AXES)


@pytest.mark.parametrize("distance", [4.0, 1000.0])
@pytest.mark.parametrize("eye", [(-1.0, 0.0, 0.5), (0.3, -1.0, 0.7)])
def test_the_light_of_a_room_is_read_off_a_ball(eye, distance):
    camera = camera_of_ball(distance * np.array(eye) / np.linalg.norm(eye), distance)
    found = unwrap_ball(ball(camera, 20.0), camera).light().irradiance(AXES)
    np.testing.assert_allclose(found, irradiance(20.0), rtol=0.03)


def test_a_clipped_lamp_is_recovered_from_darker_pictures():
    camera = camera_of_ball((-4.0, 0.0, 1.0), np.sqrt(17.0))
    truth = ball(camera, 20.0)
    bracket = [np.clip(srgb_from_linear(truth * 2.0**stops), 0, 1) for stops in EXPOSURES]
    bracket = np.round(np.array(bracket) * 255) / 255
    found = unwrap_ball(merge_exposures(bracket, EXPOSURES), camera).light().irradiance(AXES)
    np.testing.assert_allclose(found, irradiance(20.0), rtol=0.04)
    alone = unwrap_ball(merge_exposures(bracket[:1], EXPOSURES[:1]), camera).light().irradiance(AXES)
    assert alone[2].mean() < 0.8 * irradiance(20.0)[2].mean()


def test_a_lamp_is_as_bright_as_the_first_picture_that_does_not_clip_it_says():
    radiance = np.array([0.01, 0.3, 4.0, 25.0])[None, :, None] * np.ones(3)
    bracket = [np.clip(srgb_from_linear(radiance * 2.0**stops), 0, 1) for stops in EXPOSURES]
    np.testing.assert_allclose(merge_exposures(bracket, EXPOSURES), radiance, rtol=1e-9)
