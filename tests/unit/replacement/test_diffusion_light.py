"""The ball's photograph, and a tiny pipeline with random weights, saved and loaded as a real one is."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians
from aomgen.errors import BackendError
from aomgen.replacement import diffusion_light
from aomgen.replacement.diffusion_light import (
    central_photograph,
    environment_of_photograph,
    load_pipeline,
    square_scene,
)
from aomgen.replacement.mosaic import Photograph

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


@pytest.mark.skipif(has_diffusers, reason="diffusers is installed")
def test_without_the_extra_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        BackendError, match=r"diffusers: cannot be loaded .*pip install 'aomgen\[diffusion\]'"
    ):
        load_pipeline(tmp_path)


def tiny_pipeline(folder: Path) -> None:
    """Every network of the real pipeline, a few channels wide."""
    import diffusers
    import torch
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

    torch.manual_seed(0)
    words = {chr(33 + n): n for n in range(94)} | {chr(33 + n) + "</w>": 94 + n for n in range(94)}
    words |= {"<|startoftext|>": 188, "<|endoftext|>": 189}
    blocks: dict[str, Any] = {
        "block_out_channels": (32, 64),
        "layers_per_block": 1,
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "attention_head_dim": (2, 4),
        "use_linear_projection": True,
        "addition_embed_type": "text_time",
        "addition_time_embed_dim": 8,
        "transformer_layers_per_block": (1, 2),
        "projection_class_embeddings_input_dim": 80,
        "cross_attention_dim": 64,
    }
    text = CLIPTextConfig(
        bos_token_id=188,
        eos_token_id=189,
        pad_token_id=189,
        hidden_size=32,
        intermediate_size=37,
        num_attention_heads=4,
        num_hidden_layers=2,
        projection_dim=32,
        vocab_size=190,
    )
    tokenizer = CLIPTokenizer(vocab=words, merges=[], model_max_length=77)
    kind = getattr(diffusers, diffusion_light.PIPELINE)
    kind(
        vae=diffusers.AutoencoderKL(
            block_out_channels=[32, 64],
            down_block_types=["DownEncoderBlock2D"] * 2,
            up_block_types=["UpDecoderBlock2D"] * 2,
        ),
        text_encoder=CLIPTextModel(text),
        text_encoder_2=CLIPTextModelWithProjection(text),
        tokenizer=tokenizer,
        tokenizer_2=tokenizer,
        unet=diffusers.UNet2DConditionModel(
            sample_size=32, up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"), **blocks
        ),
        controlnet=diffusers.ControlNetModel(conditioning_embedding_out_channels=(16, 32), **blocks),
        scheduler=diffusers.EulerDiscreteScheduler(beta_schedule="scaled_linear", timestep_spacing="leading"),
    ).save_pretrained(folder, safe_serialization=True)


@pytest.mark.slow
@pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
def test_a_saved_pipeline_paints_balls_and_gives_an_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diffusion_light, "STEPS", 2)
    monkeypatch.setattr(diffusion_light, "BALLS", 2)
    tiny_pipeline(tmp_path)
    first, again, other = (
        environment_of_photograph(tmp_path, photograph(), post(), seed).radiance_linear for seed in (1, 1, 2)
    )
    assert first.shape == (256, 512, 3)
    assert first.min() >= 0
    assert np.isfinite(first).all()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.skipif(not has_diffusers, reason="needs the extra `diffusion`")
def test_a_folder_without_a_pipeline_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="holds no StableDiffusionXLControlNetInpaintPipeline"):
        load_pipeline(tmp_path)
