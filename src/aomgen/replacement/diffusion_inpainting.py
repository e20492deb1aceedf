"""What nobody saw of a surface, painted by a diffusion model in place of patches."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.values import Array
from aomgen.replacement.diffusion_pipeline import load_pipeline, noise, picture_side
from aomgen.replacement.inpainting import continue_smoothly

PIPELINE: Final = "StableDiffusionInpaintPipeline"
WANTED: Final = "an empty table top seen from straight above, its material going on evenly"
UNWANTED: Final = "objects, shadows, reflections, text, borders"
STEPS, GUIDANCE = 50, 7.5


def paint_unknown(folder: Path, image: Array, known: NDArray[np.bool_], seed: int) -> Array:
    """Complete an image (H, W, 3), 0..1, where it is not known (H, W); without any known pixel it is grey.

    What is painted is shifted in color, smoothly, so that it goes on from what is known.

    Args:
        folder: A pipeline `PIPELINE`, as diffusers saves it.
        seed: Of the noise.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.

    Not checked: whether the model paints things on the table.
    """
    if not known.any():
        return np.full(image.shape, 0.5)
    pipeline = load_pipeline(folder, PIPELINE)
    (height, width), side = known.shape, picture_side(pipeline)
    # The model also sees what it shall paint over, and its networks are square.
    seen = np.where(known[..., None], image, continue_smoothly(image, known))
    square = [(0, max(height, width) - length) for length in (height, width)]
    painted = pipeline(
        prompt=WANTED,
        negative_prompt=UNWANTED,
        image=_picture(np.pad(seen, [*square, (0, 0)], mode="edge"), side),
        mask_image=_picture(np.pad((~known).astype(float), square), side),
        width=side,
        height=side,
        num_inference_steps=STEPS,
        guidance_scale=GUIDANCE,
        generator=noise(seed),
        output_type="pil",
    ).images[0]
    longest = max(height, width)
    found = np.asarray(painted.resize((longest, longest)), np.float64)[:height, :width] / 255
    shifted = found + continue_smoothly(image - found, known)
    return np.where(known[..., None], image, np.clip(shifted, 0, 1))


def _picture(image: Array, side: int) -> Image.Image:
    return Image.fromarray((255 * image).astype(np.uint8)).resize((side, side))
