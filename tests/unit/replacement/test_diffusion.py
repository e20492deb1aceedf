"""Saved diffusion pipelines: tiny ones that inpaint balls into a photograph, or an unobserved table."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.errors import BackendError
from aomgen.replacement import diffusion
from aomgen.replacement.diffusion import (
    LIGHT_PIPELINE,
    MASK_SHARE,
    TABLE_PIPELINE,
    choose_photograph,
    crop_square,
    estimate_environment,
    inpaint_table,
    load_pipeline,
    mark_disc,
    measure_nearness,
)
from aomgen.replacement.table_texture import Photograph
from tiny_diffusion import save_inpainting_pipeline, save_light_pipeline

has_diffusers = importlib.util.find_spec("diffusers") is not None


def photograph(target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Photograph:
    T = look_at((-2.0, 0.0, 1.0), target)
    camera = Camera(fx=100, fy=100, cx=48, cy=32, width=96, height=64, T_world_cam=T)
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3)).astype(np.uint8)
    return Photograph(camera=camera, image_srgb=image)


def post() -> Gaussians:
    """One opaque object at the left border of the square image."""
    return Gaussians(
        means=np.array([[0.0, 0.5, 0.0]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.full((1, 3), 0.1),
        opacities=np.array([0.99]),
        sh=np.zeros((1, 1, 3)),
    )


def test_the_photograph_that_looks_at_the_place_is_taken() -> None:
    views = [photograph((0.0, 0.5, 0.0)), photograph(), photograph((0.0, 0.0, 1.0))]
    assert choose_photograph(views, np.zeros(3)) is views[1]


def test_the_middle_of_the_photograph_with_a_ball_before_it() -> None:
    square = crop_square(photograph(), 64)
    nearness = measure_nearness(post(), square.camera)
    mask = mark_disc(64, MASK_SHARE)
    np.testing.assert_array_equal(square.image_srgb, photograph().image_srgb[:, 16:80])
    # The ball and the post are near, the rest is far; the mask is a little wider than the ball.
    assert nearness[32, 32] == 255
    pixel = square.camera.project(np.array([[0.0, 0.5, 0.0]]))[0][0].astype(int)
    assert nearness[pixel[1], pixel[0]] > 200
    assert nearness[4, 60] == 0
    assert mask[32, 32 + 8]
    assert not mask[32, 32 + 9]
    assert not mask[0, 0]
    assert mask.sum() > np.pi * 8**2


@pytest.mark.slow
@pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
def test_a_saved_pipeline_paints_balls_and_gives_an_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diffusion, "LIGHT_STEPS", 2)
    monkeypatch.setattr(diffusion, "BALLS", 2)
    save_light_pipeline(tmp_path)
    first, again, other = (
        estimate_environment(tmp_path, photograph(), post(), seed).radiance_linear for seed in (1, 1, 2)
    )
    assert first.shape == (256, 512, 3)
    assert first.min() >= 0
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


needs_diffusers = pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
KINDS = (LIGHT_PIPELINE, TABLE_PIPELINE)


@pytest.mark.skipif(has_diffusers, reason="diffusers is installed")
def test_without_the_extra_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        BackendError, match=r"diffusers: cannot be loaded .*pip install 'aomgen\[diffusion\]'"
    ):
        load_pipeline(tmp_path, KINDS[0])


@needs_diffusers
@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_without_a_pipeline_is_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(BackendError, match=f"holds no {kind}"):
        load_pipeline(tmp_path, kind)


@pytest.mark.slow
@needs_diffusers
def test_a_saved_pipeline_paints_what_is_not_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diffusion, "TABLE_STEPS", 2)
    save_inpainting_pipeline(tmp_path)
    image = np.repeat(np.linspace(0.3, 0.7, 90)[None, :, None], 70, 0) * np.ones(3)
    known = np.ones((70, 90), bool)
    known[20:50, 30:60] = False
    hidden = np.where(known[..., None], image, 0.0)
    first, again, other = (inpaint_table(tmp_path, hidden, known, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[known], image[known])
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # Random weights paint anything; in the mean it goes on from the border.
    assert abs(first[~known].mean() - image[~known].mean()) < 0.1
    assert (inpaint_table(tmp_path, image, np.zeros((70, 90), bool), 1) == 0.5).all()
