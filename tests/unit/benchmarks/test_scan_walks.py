import numpy as np

from aomgen.core.camera import Camera, look_at
from benchmarks.scan_walks import spread, stay_on_one_side, turn_on_the_spot

TARGET = np.array([0.4, -0.2, 0.1])


def circle(count: int) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [TARGET + [np.cos(angle), np.sin(angle), 0.5] for angle in angles]
    return [
        Camera(fx=300, fy=300, cx=128, cy=96, width=256, height=192, T_world_cam=look_at(eye, TARGET))
        for eye in eyes
    ]


def test_one_side_is_a_sixth_of_a_circle():
    # 24 cameras are 15 degrees apart: the first, and one on either side within 30 degrees.
    assert [camera.center[1] < TARGET[1] for camera in stay_on_one_side(circle(24), TARGET)] == [
        False,
        False,
        True,
    ]


def test_turning_keeps_the_position():
    cameras = circle(8)
    walk = turn_on_the_spot(cameras, TARGET)
    np.testing.assert_allclose(
        [camera.center for camera in walk], [cameras[0].center] * len(walk), atol=1e-12
    )
    pixels = np.array([camera.project(TARGET[None])[0][0] for camera in walk])
    assert (np.diff(pixels[:, 0]) < 0).all() or (np.diff(pixels[:, 0]) > 0).all()


def test_five_images_are_spread_over_the_walk():
    cameras = circle(20)
    assert [id(camera) for camera in spread(cameras)] == [id(cameras[index]) for index in (0, 4, 8, 11, 15)]
