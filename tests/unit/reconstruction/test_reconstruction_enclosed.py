"""A side of the object that no mask reached is found by the object's box."""

import numpy as np

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.transforms import matrix_from_rotvec
from aomgen.reconstruction.parts.enclosed import upright_box_axes, with_enclosed

SIZE = np.array([0.5, 0.4, 0.3])


def box_surface(yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on a box's six faces (0..5: -x, +x, -y, +y, -z, +z), turned by a yaw."""
    rng = np.random.default_rng(0)
    points, faces = [], []
    for face in range(6):
        local = rng.random((600, 3))
        local[:, face // 2] = face % 2
        points.append((local - [0.5, 0.5, 0.0]) * SIZE)
        faces += [face] * 600
    R = matrix_from_rotvec([0, 0, yaw])
    return np.concatenate(points) @ R.T + [0.7, 0.1, 0.05], np.array(faces)


def test_a_missed_side_becomes_static_and_the_rest_stays():
    means, faces = box_surface(0.4)
    table = np.column_stack([np.random.default_rng(1).uniform(-0.2, 1.5, (2000, 2)), np.full(2000, 0.05)])
    everything = np.concatenate([means, table])
    labels = np.full(len(everything), BACKGROUND, np.uint8)
    labels[: len(means)][faces == 2] = MOVING
    labels[: len(means)][(faces != 2) & (faces != 0)] = STATIC
    result = with_enclosed(everything, np.ones(len(everything)), labels)
    missed = np.flatnonzero((faces == 0) & (means[:, 2] > 0.05 + 0.1 * SIZE[2]))
    assert np.mean(result[missed] == STATIC) > 0.98
    assert np.all(result[labels != BACKGROUND] == labels[labels != BACKGROUND])
    assert np.all(result[len(means) :] == BACKGROUND), "the table stays"


def test_a_piece_of_an_open_door_moves_and_the_air_beside_it_is_not_the_body():
    body, _ = box_surface(0.0)
    rng = np.random.default_rng(2)
    # A door that stands out from the corner of the front at y = -0.1, its handle, and the table before the body.
    door = rng.uniform([0.45, -0.5, 0.07], [0.47, -0.1, 0.33], (800, 3))
    handle = rng.uniform([0.42, -0.46, 0.15], [0.455, -0.44, 0.25], (60, 3))
    table = np.column_stack([rng.uniform([0.5, -0.45], [0.9, -0.15], (500, 2)), np.full(500, 0.08)])
    everything = np.concatenate([body, door, handle, table])
    labels = np.full(len(everything), BACKGROUND, np.uint8)
    labels[: len(body)] = STATIC
    labels[len(body) : len(body) + len(door)] = MOVING
    labels[-560:-500:2] = MOVING  # half of the handle was found
    result = with_enclosed(everything, np.ones(len(everything)), labels)
    assert np.mean(result[-560:-500] == MOVING) > 0.9
    assert np.all(result[-500:] == BACKGROUND)


def test_the_rectangle_follows_the_object():
    means, _ = box_surface(0.4)
    axis = upright_box_axes(means[:, :2])[:, 0]
    angle = np.degrees(np.arctan2(axis[1], axis[0])) % 90
    assert abs(angle - np.degrees(0.4)) < 2
