"""The ball's photograph, and a tiny pipeline that paints balls into it."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.replacement import diffusion_light
from aomgen.replacement.diffusion_light import (
    central_photograph,
    environment_of_photograph,
    square_scene,
)
from aomgen.replacement.mosaic import Photograph
from tiny_diffusion import save_light_pipeline

has_diffusers = importlib.util.find_spec("diffusers") is not None


def photograph(target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Photograph:
    T = look_at((-2.0, 0.0, 1.0), target)
    camera = Camera(fx=100, fy=100, cx=48, cy=32, width=96, height=64, T_world_cam=T)
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3)).astype(np.uint8)
    return Photograph(camera=camera, image_srgb=image)


def post() -> Gaussians:
    """One opaque thing at the left border of the square picture."""
    return Gaussians(
        means=np.array([[0.0, 0.5, 0.0]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.full((1, 3), 0.1),
        opacities=np.array([0.99]),
        sh=np.zeros((1, 1, 3)),
    )


def test_the_photograph_that_looks_at_the_place_is_taken() -> None:
    views = [photograph((0.0, 0.5, 0.0)), photograph(), photograph((0.0, 0.0, 1.0))]
    assert central_photograph(views, np.zeros(3)) is views[1]


def test_the_middle_of_the_photograph_with_a_ball_before_it() -> None:
    scene = square_scene(photograph(), post(), 64)
    np.testing.assert_array_equal(scene.image_srgb, photograph().image_srgb[:, 16:80])
    # The ball and the post are near, the rest is far; the mask is a little wider than the ball.
    assert scene.nearness[32, 32] == 255
    pixel = scene.camera.project(np.array([[0.0, 0.5, 0.0]]))[0][0].astype(int)
    assert scene.nearness[pixel[1], pixel[0]] > 200
    assert scene.nearness[4, 60] == 0
    assert scene.mask[32, 32 + 8] == 255
    assert scene.mask[32, 32 + 9] == scene.mask[0, 0] == 0
    assert (scene.mask > 0).sum() > np.pi * 8**2


@pytest.mark.slow
@pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
def test_a_saved_pipeline_paints_balls_and_gives_an_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diffusion_light, "STEPS", 2)
    monkeypatch.setattr(diffusion_light, "BALLS", 2)
    save_light_pipeline(tmp_path)
    first, again, other = (
        environment_of_photograph(tmp_path, photograph(), post(), seed).radiance_linear for seed in (1, 1, 2)
    )
    assert first.shape == (256, 512, 3)
    assert first.min() >= 0
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
