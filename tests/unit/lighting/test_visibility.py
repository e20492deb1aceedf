"""Rays past bodies, and the transfer of points near them."""

import numpy as np

from aomgen.core.light import hemisphere_light, open_transfer
from aomgen.core.sh import sphere_directions
from aomgen.lighting.visibility import BODY_CELLS, Occluders, estimate_transfer, find_visibility


def block() -> np.ndarray:
    """A filled cube of a meter about (2, 0, 0)."""
    return np.random.default_rng(0).uniform((1.5, -0.5, -0.5), (2.5, 0.5, 0.5), (60_000, 3))


def test_a_body_blocks_what_it_is_before_and_nothing_behind_the_eye():
    starts = np.array([[0.0, 0, 0], [0, 0.9, 0], [4.0, 0, 0], [2.0, 0, 3.0]])
    ways = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, -1.0]])
    occluders = Occluders(block(), BODY_CELLS)
    found = [(~occluders.blocks(starts, way)).tolist() for way in ways]
    assert found == [[0, 1, 1, 1], [1, 1, 0, 1], [1, 1, 1, 0]]


def test_light_is_visible_from_the_front_past_the_body():
    points, normals = np.array([[0.0, 0, 0], [4.0, 0, 0]]), np.array([[1.0, 0, 0], [1.0, 0, 0]])
    directions = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [-1.0, 0, 0]])
    found = find_visibility(points, normals, Occluders(block(), BODY_CELLS), directions)
    assert found.tolist() == [[False, True, False], [True, True, False]]


def test_transfer_past_a_body_is_open_far_from_it_and_small_behind_it():
    normals = np.tile([1.0, 0.0, 0.0], (3, 1))
    points = np.array([[1.3, 0.0, 0.0], [-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    (near, far, turned_away), _ = estimate_transfer(points, normals, Occluders(block(), BODY_CELLS))
    want = open_transfer(normals[:1])[0]
    np.testing.assert_allclose(turned_away, want, atol=0.03)
    # A cube of a meter covers some three hundredths of the cosine from five meters away.
    np.testing.assert_allclose(far, want, atol=0.05)
    assert near[0] < 0.6 * want[0]


def test_irradiance_is_what_the_transfer_gives():
    """Where all is visible, the sum over directions is the product of harmonics."""
    light, normals = hemisphere_light((0.9, 0.8, 0.7), (0.3, 0.2, 0.1)), sphere_directions(50)
    np.testing.assert_allclose(
        light.irradiance(normals), open_transfer(normals) @ light.radiance_sh, atol=2e-3
    )
    np.testing.assert_allclose(light.irradiance(normals, 0.5), 0.5 * light.irradiance(normals), rtol=1e-12)
