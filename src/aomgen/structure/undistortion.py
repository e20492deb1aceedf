"""Undistortion of the images, masks and prompts of a scan."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from aomgen.core.lens import Lens, undistort_labels, undistorter
from aomgen.core.progress import Progress
from aomgen.core.recording import Capture, Prompt
from aomgen.core.structure import PinholeScan
from aomgen.io.atomic import write_bytes
from aomgen.io.images import encode_jpeg, encode_png, read_image, read_labels

IMAGES_FOLDER = "straight"
MASKS_FOLDER = "straight_masks"
# The second compression of a photograph has to stay invisible.
JPEG_QUALITY = 98

# Points along each side of a box that are undistorted: its curved outline deviates by less than a pixel
# between them.
EDGE_SAMPLES = 16


def undistort_prompts(prompts: tuple[Prompt, ...], lens: Lens) -> tuple[Prompt, ...]:
    """Transform prompts to the pixels of the undistorted images.

    A box becomes the box around its undistorted outline, cut at the image's border; a point that
    the undistorted image no longer shows is left out, and so is a prompt of which nothing is left.
    """
    undistorted = (_undistort(prompt, lens) for prompt in prompts)
    return tuple(prompt for prompt in undistorted if len(prompt.points) or len(prompt.box))


def undistort_scan(
    images: dict[str, Path], capture: Capture, lens: Lens, folder: Path, progress: Progress
) -> PinholeScan:
    """Write undistorted copies of scan images and their masks below `folder`, names kept.

    Masks of other images or of another size are left out.

    Raises:
        InputError: An image or mask cannot be read.
        StorageError: The disk refuses.
    """
    undistort = undistorter(lens)
    for index, (name, path) in enumerate(sorted(images.items())):
        progress(index / len(images), "straightening images")
        image = undistort(read_image(path))
        lossy = path.suffix.lower() in (".jpg", ".jpeg")
        data = encode_jpeg(image, JPEG_QUALITY) if lossy else encode_png(image)
        write_bytes(folder / IMAGES_FOLDER / name, data)
    stems = {Path(name).stem for name in images}
    written = {}
    for masks, source in sorted(capture.mask_folders.items()):
        for path in sorted(source.glob("*.png")):
            labels = read_labels(path)
            if path.stem in stems and labels.shape == (lens.height, lens.width):
                labels = undistort_labels(labels, lens)
                write_bytes(folder / MASKS_FOLDER / masks / path.name, encode_png(labels))
                written[masks] = f"{MASKS_FOLDER}/{masks}"
    return PinholeScan(
        images=tuple(f"{IMAGES_FOLDER}/{name}" for name in images),
        masks=written,
        prompts=undistort_prompts(capture.prompts, lens),
    )


def _undistort(prompt: Prompt, lens: Lens) -> Prompt:
    size = np.array([lens.width, lens.height], np.float64)
    points = prompt.points
    if len(points):
        pixels = lens.straightened(points[:, :2])
        kept = ((pixels >= 0) & (pixels <= size)).all(1)
        points = np.concatenate([pixels, points[:, 2:]], 1)[kept]
    box = prompt.box
    if len(box):
        x0, y0, x1, y1 = box
        share = np.linspace(0.0, 1.0, EDGE_SAMPLES)
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        edges = [(x, y0), (x, y1), (x0, y), (x1, y)]
        outline = np.concatenate([np.stack(np.broadcast_arrays(u, v), 1) for u, v in edges])
        pixels = np.clip(lens.straightened(outline), 0, size)
        low, high = pixels.min(0), pixels.max(0)
        box = np.concatenate([low, high]) if (high - low > 1).all() else np.zeros(0)
    return replace(prompt, points=points, box=box)
