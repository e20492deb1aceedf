"""Light from all around, from one photograph: a diffusion model paints a mirroring ball into it at several exposures.

The depth that guides the model is the scan's. Source: Phongthawee et al., DiffusionLight, CVPR 2024.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.camera import Camera
from aomgen.core.environment_map import EnvironmentMap
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.replacement.chrome_ball import merge_exposures, unwrap_ball
from aomgen.replacement.diffusion_pipeline import load_pipeline, noise, picture_side
from aomgen.replacement.mosaic import Photograph
from aomgen.splatting.rasterizer import render

PIPELINE: Final = "StableDiffusionXLControlNetInpaintPipeline"
# What the paper asks for at the brightest and at the darkest exposure, and what it does not want.
BRIGHT: Final = "a perfect mirrored reflective chrome ball sphere"
DARK: Final = "a perfect black dark mirrored reflective chrome ball sphere"
UNWANTED: Final = "matte, diffuse, flat, dull"
# Exposures, in stops, brightest first.
EXPOSURES: Final = (0.0, -2.5, -5.0)
# Radius of the ball, and of what is painted anew, as shares of the picture's side.
BALL_SHARE, MASK_SHARE = 0.125, 0.135
# Balls painted into the photograph, whose median is painted over with this strength.
BALLS, SECOND_STRENGTH = 5, 0.8
# How the paper samples: steps, guidance by the text, weight of the depth.
STEPS, GUIDANCE, DEPTH_WEIGHT = 30, 5.0, 0.5
# Quantile of nearness that is white to the depth network; single Gaussians float before the camera.
NEAREST: Final = 0.98


@dataclass(frozen=True, slots=True, kw_only=True)
class BallScene:
    """A square photograph (S, S, 3) with its camera, and what guides and bounds the ball painted into it."""

    camera: Camera
    image_srgb: NDArray[np.uint8]
    nearness: NDArray[np.uint8]
    mask: NDArray[np.uint8]


def environment_of_photograph(
    folder: Path, photograph: Photograph, world: Gaussians, seed: int
) -> EnvironmentMap:
    """Light around the middle of a photograph.

    Args:
        folder: A pipeline `PIPELINE`, as diffusers saves it.
        photograph: Of the scan.
        world: What it shows, world frame.
        seed: Chooses the balls.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.

    Not checked: whether the painted ball mirrors the room; the model may invent it.
    """
    pipeline = load_pipeline(folder, PIPELINE)
    side = picture_side(pipeline)
    scene = square_scene(photograph, world, side)
    pictures = np.stack([_paint_ball(pipeline, scene, exposure, seed) for exposure in EXPOSURES])
    radius = round(BALL_SHARE * side)
    low, high = side // 2 - radius, side // 2 + radius
    radiance = merge_exposures(pictures[:, low:high, low:high], EXPOSURES)
    return unwrap_ball(radiance, scene.camera.crop(low, low, high - low))


def central_photograph(views: Sequence[Photograph], place: Array) -> Photograph:
    """The photograph whose middle is nearest to a place (3,), world frame."""

    def nearness(view: Photograph) -> float:
        way = place - view.camera.center
        return float(view.camera.T_world_cam[:3, 2] @ way / np.linalg.norm(way))

    return max(views, key=nearness)


def square_scene(photograph: Photograph, world: Gaussians, side: int) -> BallScene:
    """The middle of a photograph, `side` pixels wide, with a ball before everything else."""
    height, width = photograph.image_srgb.shape[:2]
    size = min(height, width)
    left, top = (width - size) // 2, (height - size) // 2
    camera = photograph.camera.resize(width, height).crop(left, top, size).resize(side, side)
    square = Image.fromarray(photograph.image_srgb).crop((left, top, left + size, top + size))
    across = (np.arange(side) + 0.5) / side - 0.5
    distance = np.hypot(across, across[:, None])
    depth = render(world, camera).depth
    nearness = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    low, high = nearness.min(), max(np.quantile(nearness, NEAREST), 1e-6)
    nearness = np.where(distance < BALL_SHARE, 1, np.clip((nearness - low) / max(high - low, 1e-6), 0, 1))
    return BallScene(
        camera=camera,
        image_srgb=np.asarray(square.resize((side, side))),
        nearness=(255 * nearness).astype(np.uint8),
        mask=np.where(distance < MASK_SHARE, 255, 0).astype(np.uint8),
    )


def _paint_ball(pipeline: Any, scene: BallScene, exposure: float, seed: int) -> Array:
    """The photograph (S, S, 3), 0..1, with a ball: the median of several, painted over."""
    text = _text(pipeline, exposure / EXPOSURES[-1])
    image = Image.fromarray(scene.image_srgb)
    balls = [_inpaint(pipeline, scene, text, image, 1.0, seed + number) for number in range(BALLS)]
    median = Image.fromarray((255 * np.median(balls, 0)).astype(np.uint8))
    return _inpaint(pipeline, scene, text, median, SECOND_STRENGTH, seed)


def _text(pipeline: Any, darkness: float) -> dict[str, Any]:
    """What the model is asked for: between `BRIGHT`, 0, and `DARK`, 1."""
    (bright, no, bright_pooled, no_pooled), (dark, _, dark_pooled, _) = (
        pipeline.encode_prompt(words, negative_prompt=UNWANTED) for words in (BRIGHT, DARK)
    )
    return {
        "prompt_embeds": bright + darkness * (dark - bright),
        "pooled_prompt_embeds": bright_pooled + darkness * (dark_pooled - bright_pooled),
        "negative_prompt_embeds": no,
        "negative_pooled_prompt_embeds": no_pooled,
    }


def _inpaint(
    pipeline: Any, scene: BallScene, text: dict[str, Any], image: Image.Image, strength: float, seed: int
) -> Array:
    painted = pipeline(
        **text,
        image=image,
        mask_image=Image.fromarray(scene.mask),
        control_image=Image.fromarray(scene.nearness).convert("RGB"),
        width=image.width,
        height=image.height,
        strength=strength,
        num_inference_steps=STEPS,
        guidance_scale=GUIDANCE,
        controlnet_conditioning_scale=DEPTH_WEIGHT,
        generator=noise(seed),
        output_type="np",
    )
    return np.asarray(painted.images[0], np.float64)
