"""Diffusion pipelines with random weights and networks of a few channels, saved as real ones are."""

from pathlib import Path
from typing import Any

BLOCKS: dict[str, Any] = {
    "block_out_channels": (32, 64),
    "layers_per_block": 1,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "attention_head_dim": (2, 4),
}
UP_BLOCKS = ("CrossAttnUpBlock2D", "UpBlock2D")
XL_BLOCKS: dict[str, Any] = {
    **BLOCKS,
    "use_linear_projection": True,
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 8,
    "transformer_layers_per_block": (1, 2),
    "projection_class_embeddings_input_dim": 80,
    "cross_attention_dim": 64,
}
# Side of their pictures, [px].
SIDE = 64


def save_light_pipeline(folder: Path) -> None:
    """Save a pipeline as `replacement.diffusion.estimate_environment` loads it."""
    import diffusers
    from transformers import CLIPTextModelWithProjection

    text, tokenizer, shared = _networks(diffusers.EulerDiscreteScheduler)
    diffusers.StableDiffusionXLControlNetInpaintPipeline(
        **shared,
        text_encoder_2=CLIPTextModelWithProjection(text),
        tokenizer_2=tokenizer,
        unet=diffusers.UNet2DConditionModel(sample_size=SIDE // 2, up_block_types=UP_BLOCKS, **XL_BLOCKS),
        controlnet=diffusers.ControlNetModel(conditioning_embedding_out_channels=(16, 32), **XL_BLOCKS),
    ).save_pretrained(folder, safe_serialization=True)


def save_inpainting_pipeline(folder: Path) -> None:
    """Save a pipeline as `replacement.diffusion.inpaint_table` loads it."""
    import diffusers

    _, _, shared = _networks(diffusers.DDIMScheduler)
    # Beside the picture's channels its mask and what is known of it.
    unet = diffusers.UNet2DConditionModel(
        sample_size=SIDE // 2, in_channels=9, up_block_types=UP_BLOCKS, cross_attention_dim=32, **BLOCKS
    )
    diffusers.StableDiffusionInpaintPipeline(
        **shared, unet=unet, safety_checker=None, feature_extractor=None, requires_safety_checker=False
    ).save_pretrained(folder, safe_serialization=True)


def _networks(scheduler: Any) -> tuple[Any, Any, dict[str, Any]]:
    """Create the text encoder's settings, the tokenizer, and the networks that all pipelines share."""
    import diffusers
    import torch
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(0)
    words = {chr(33 + n): n for n in range(94)} | {chr(33 + n) + "</w>": 94 + n for n in range(94)}
    words |= {"<|startoftext|>": 188, "<|endoftext|>": 189}
    tokenizer = CLIPTokenizer(vocab=words, merges=[], model_max_length=77)
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
    shared = {
        "vae": diffusers.AutoencoderKL(
            block_out_channels=[32, 64],
            down_block_types=["DownEncoderBlock2D"] * 2,
            up_block_types=["UpDecoderBlock2D"] * 2,
        ),
        "text_encoder": CLIPTextModel(text),
        "tokenizer": tokenizer,
        "scheduler": scheduler(beta_schedule="scaled_linear", timestep_spacing="leading"),
    }
    return text, tokenizer, shared
