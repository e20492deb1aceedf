"""Light and unobserved table regions by diffusion models that diffusers has saved in a folder; a run downloads nothing.

The light from all directions is estimated from one photograph: a model inpaints a mirror ball into it at several exposures,
guided by the scan's depth. Source: Phongthawee et al., DiffusionLight, CVPR 2024.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.camera import Camera
from aomgen.core.environment_map import EnvironmentMap
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.errors import BackendError
from aomgen.lighting.chrome_ball import merge_exposures, unwrap_ball
from aomgen.replacement.table_texture import Photograph, continue_smoothly
from aomgen.splatting.rasterizer import render

EXTRA: Final = "pip install 'aomgen[diffusion]'"
LIGHT_PIPELINE: Final = "StableDiffusionXLControlNetInpaintPipeline"
TABLE_PIPELINE: Final = "StableDiffusionInpaintPipeline"
# Prompts of the paper at the brightest and at the darkest exposure, and its negative prompt.
BRIGHT: Final = "a perfect mirrored reflective chrome ball sphere"
DARK: Final = "a perfect black dark mirrored reflective chrome ball sphere"
NO_BALL: Final = "matte, diffuse, flat, dull"
# Exposures, in stops, brightest first.
EXPOSURES: Final = (0.0, -2.5, -5.0)
# Radius of the ball, and of the inpainted disc, as shares of the image's side.
BALL_SHARE, MASK_SHARE = 0.125, 0.135
# Number of balls, and the strength with which their median is inpainted again.
BALLS, SECOND_STRENGTH = 5, 0.8
# Sampling of the paper: steps, guidance by the text, weight of the depth.
LIGHT_STEPS, LIGHT_GUIDANCE, DEPTH_WEIGHT = 30, 5.0, 0.5
# Quantile of the inverse depth that is white for the depth network, because single Gaussians float in front of the camera.
NEAREST: Final = 0.98
TABLE: Final = "an empty table top seen from straight above, its material going on evenly"
NO_TABLE: Final = "objects, shadows, reflections, text, borders"
TABLE_STEPS, TABLE_GUIDANCE = 50, 7.5


def load_pipeline(folder: Path, kind: str) -> Any:
    """Load a saved pipeline of a class of diffusers, on the GPU where there is one.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.
    """
    try:
        pipelines = getattr(importlib.import_module("diffusers"), kind)
        torch = importlib.import_module("torch")
        damaged = importlib.import_module("safetensors").SafetensorError
    except ImportError as error:
        raise BackendError("diffusers", f"cannot be loaded ({error})", EXTRA) from error
    on_gpu = torch.cuda.is_available()
    try:
        pipeline = pipelines.from_pretrained(
            str(folder),
            dtype=torch.float16 if on_gpu else torch.float32,
            local_files_only=True,
            use_safetensors=True,
        )
    except (OSError, ValueError, TypeError, RuntimeError, damaged) as error:
        raise BackendError(
            folder, f"holds no {kind} ({error})", "save one there, see docs/replacement.md"
        ) from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cuda" if on_gpu else "cpu")


def estimate_environment(folder: Path, photograph: Photograph, world: Gaussians, seed: int) -> EnvironmentMap:
    """Estimate the light at the location that the center of a photograph shows.

    Args:
        folder: A pipeline `LIGHT_PIPELINE`, as diffusers saves it.
        photograph: Photograph of the scan.
        world: The scanned Gaussians, world frame.
        seed: Seed of the balls.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.

    Not checked: whether the ball reflects the room; the model may invent it.
    """
    pipeline = load_pipeline(folder, LIGHT_PIPELINE)
    side = _image_side(pipeline)
    square = crop_square(photograph, side)
    nearness = measure_nearness(world, square.camera)
    images = np.stack([_add_ball(pipeline, square, nearness, exposure, seed) for exposure in EXPOSURES])
    radius = round(BALL_SHARE * side)
    low, high = side // 2 - radius, side // 2 + radius
    radiance = merge_exposures(images[:, low:high, low:high], EXPOSURES)
    return unwrap_ball(radiance, square.camera.crop(low, low, high - low))


def choose_photograph(views: Sequence[Photograph], point: Array) -> Photograph:
    """Choose the photograph whose middle is nearest to a point (3,), world frame."""

    def nearness(view: Photograph) -> float:
        ray = point - view.camera.center
        return float(view.camera.T_world_cam[:3, 2] @ ray / np.linalg.norm(ray))

    return max(views, key=nearness)


def crop_square(photograph: Photograph, side: int) -> Photograph:
    """Crop the middle of a photograph and resize it to `side` pixels."""
    height, width = photograph.image_srgb.shape[:2]
    size = min(height, width)
    left, top = (width - size) // 2, (height - size) // 2
    camera = photograph.camera.resize(width, height).crop(left, top, size).resize(side, side)
    square = Image.fromarray(photograph.image_srgb).crop((left, top, left + size, top + size))
    return Photograph(camera=camera, image_srgb=np.asarray(square.resize((side, side))))


def measure_nearness(world: Gaussians, camera: Camera) -> NDArray[np.uint8]:
    """Render the inverse depth (S, S) of a scene, scaled as the depth network expects, with a ball in front of the scene."""
    depth = render(world, camera).depth
    nearness = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    low, high = nearness.min(), max(np.quantile(nearness, NEAREST), 1e-6)
    nearness = np.clip((nearness - low) / max(high - low, 1e-6), 0, 1)
    return np.where(mark_disc(camera.width, BALL_SHARE), 255, 255 * nearness).astype(np.uint8)


def mark_disc(side: int, radius: float) -> NDArray[np.bool_]:
    """Mark the pixels of a square image in a disc at its center; the radius is a fraction of the side."""
    across = (np.arange(side) + 0.5) / side - 0.5
    return np.hypot(across, across[:, None]) < radius


def _add_ball(
    pipeline: Any, square: Photograph, nearness: NDArray[np.uint8], exposure: float, seed: int
) -> Array:
    """Inpaint a ball in a photograph; return (S, S, 3), 0..1. The median of several balls is inpainted once more."""
    darkness = exposure / EXPOSURES[-1]
    (bright, no, bright_pooled, no_pooled), (dark, _, dark_pooled, _) = (
        pipeline.encode_prompt(words, negative_prompt=NO_BALL) for words in (BRIGHT, DARK)
    )
    mask = np.where(mark_disc(len(nearness), MASK_SHARE), np.uint8(255), np.uint8(0))

    def inpaint(image: Image.Image, strength: float, seed: int) -> Array:
        inpainted = pipeline(
            prompt_embeds=bright + darkness * (dark - bright),
            pooled_prompt_embeds=bright_pooled + darkness * (dark_pooled - bright_pooled),
            negative_prompt_embeds=no,
            negative_pooled_prompt_embeds=no_pooled,
            image=image,
            mask_image=Image.fromarray(mask),
            control_image=Image.fromarray(nearness).convert("RGB"),
            width=image.width,
            height=image.height,
            strength=strength,
            num_inference_steps=LIGHT_STEPS,
            guidance_scale=LIGHT_GUIDANCE,
            controlnet_conditioning_scale=DEPTH_WEIGHT,
            generator=_seed_noise(seed),
            output_type="np",
        )
        return np.asarray(inpainted.images[0], np.float64)

    image = Image.fromarray(square.image_srgb)
    balls = [inpaint(image, 1.0, seed + number) for number in range(BALLS)]
    median = Image.fromarray((255 * np.median(balls, 0)).astype(np.uint8))
    return inpaint(median, SECOND_STRENGTH, seed)


def inpaint_table(folder: Path, image: Array, known: NDArray[np.bool_], seed: int) -> Array:
    """Complete an image (H, W, 3), 0..1, where `known` (H, W) is False; without any known pixel it is gray.

    The synthesized colors are shifted smoothly, so that they continue the known ones.

    Args:
        folder: A pipeline `TABLE_PIPELINE`, as diffusers saves it.
        seed: Seed of the noise.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.

    Not checked: whether the model adds objects to the table.
    """
    if not known.any():
        return np.full(image.shape, 0.5)
    pipeline = load_pipeline(folder, TABLE_PIPELINE)
    (height, width), side = known.shape, _image_side(pipeline)
    # The model also sees the region that it replaces, and its networks are square.
    seen = np.where(known[..., None], image, continue_smoothly(image, known))
    square = [(0, max(height, width) - length) for length in (height, width)]

    def to_image(values: Array) -> Image.Image:
        return Image.fromarray((255 * values).astype(np.uint8)).resize((side, side))

    inpainted = pipeline(
        prompt=TABLE,
        negative_prompt=NO_TABLE,
        image=to_image(np.pad(seen, [*square, (0, 0)], mode="edge")),
        mask_image=to_image(np.pad((~known).astype(float), square)),
        width=side,
        height=side,
        num_inference_steps=TABLE_STEPS,
        guidance_scale=TABLE_GUIDANCE,
        generator=_seed_noise(seed),
        output_type="pil",
    ).images[0]
    longest = max(height, width)
    found = np.asarray(inpainted.resize((longest, longest)), np.float64)[:height, :width] / 255
    shifted = found + continue_smoothly(image - found, known)
    return np.where(known[..., None], image, np.clip(shifted, 0, 1))


def _image_side(pipeline: Any) -> int:
    """Return the side of the square images that a pipeline was trained on, [px]."""
    return int(pipeline.unet.config.sample_size * pipeline.vae_scale_factor)


def _seed_noise(seed: int) -> Any:
    """Create the generator of the initial noise on the CPU, so that the noise is the same on every computer."""
    return importlib.import_module("torch").Generator("cpu").manual_seed(seed)
