"""Segmentation and tracking with SAM 2 through `transformers`, for users who have its weights.

Images are preprocessed here, because the image processors of the library need torchvision: an image is resized to the
square input of the network and normalized, and the mask is resized back.
Source: Ravi et al., SAM 2: Segment Anything in Images and Videos, 2024.
"""

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.progress import Progress
from aomgen.core.recording import Prompt
from aomgen.errors import BackendError, InputError
from aomgen.io.artifact import read_json
from aomgen.segmentation.interface import Mask, PointMasks, PreparedImage, clean, masks_of_logits
from aomgen.segmentation.sam2_weights import CONFIG, WEIGHTS, find_sam2

# Means and standard deviations of the training images of the published networks, 0..1.
_MEAN: Final = np.array([0.485, 0.456, 0.406], np.float32)
_SPREAD: Final = np.array([0.229, 0.224, 0.225], np.float32)
# Number of points in one request, which determines the memory of the decoder.
_POINTS: Final = 16
EXTRA: Final = 'pip install "aomgen[sam2]"'
# Parts in the order in which their labels are written: those of the moving part replace those of the object.
PARTS: Final = (("static", STATIC), ("moving", MOVING))


def transformers_module(name: str) -> ModuleType:
    """Import a module of `transformers` at its first use.

    Raises:
        BackendError: The extra is not installed, or is too old.
    """
    try:
        return importlib.import_module(f"transformers.{name}")
    except ImportError as error:
        raise BackendError("transformers", f"cannot load {name} ({error})", EXTRA) from error


def load_pretrained(module: str, model: str, folder: Path) -> Any:
    """Load a network, given by its module of `transformers.models` and its class, with the weights of a folder.

    Raises:
        BackendError: transformers is missing, or the file lacks some of the network's weights.
    """
    kind = getattr(transformers_module(f"models.{module}"), model)
    damaged = importlib.import_module("safetensors").SafetensorError

    # The type of published weights is "sam2_video"; the network for images uses a part of them.
    stored = read_json(folder / CONFIG) | {"model_type": kind.config_class.model_type}
    try:
        with _quiet():
            network, found = kind.from_pretrained(
                folder,
                config=kind.config_class.from_dict(stored),
                local_files_only=True,
                use_safetensors=True,
                weights_only=True,
                output_loading_info=True,
            )
    except (OSError, ValueError, RuntimeError, damaged) as error:
        raise BackendError(
            folder / WEIGHTS, f"does not hold a {model} ({error})", "install it again"
        ) from error
    missing = sorted({*found["missing_keys"], *(item[0] for item in found["mismatched_keys"])})
    if missing:
        raise BackendError(
            folder / WEIGHTS,
            f"lacks {len(missing)} weights of a {model}, {missing[0]} for example",
            "install the published model",
        )
    return network.eval()


@contextmanager
def _quiet() -> Iterator[None]:
    """Disable the progress bar of the library."""
    logging = transformers_module("utils.logging")
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def pixel_values(image_srgb: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """Convert an image (H, W, 3), sRGB, to the normalized input of the network (3, side, side)."""
    small = Image.fromarray(image_srgb).resize((side, side), Image.Resampling.BILINEAR)
    values = (np.asarray(small, np.float32) / 255 - _MEAN) / _SPREAD
    return np.ascontiguousarray(values.transpose(2, 0, 1), np.float32)


def input_side(network: Any) -> int:
    """Return the width and height of the input of a network, [px]."""
    return int(network.config.prompt_encoder_config.image_size)


def input_points(points_px: ArrayLike, shape: tuple[int, ...], side: int) -> NDArray[np.float32]:
    """Convert points (N, 2), [px], of an image (H, W) to the network's coordinates, with pixel centers at integers."""
    scale = [side / shape[1], side / shape[0]]
    return (np.asarray(points_px, np.float64).reshape(-1, 2) * scale - 0.5).astype(np.float32)


def input_prompt(
    box_px: ArrayLike, points: ArrayLike, shape: tuple[int, ...], side: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Convert a box and points of a part (see `PreparedImage.mask`; either may be empty) to the network's coordinates.

    Returns:
        Coordinates (P, 2) and labels (P,); labels 2 and 3 are the corners, which come first.
    """
    corners = np.asarray(box_px, np.float64).reshape(-1, 2)
    clicks = np.asarray(points, np.float64).reshape(-1, 3)
    pixels = np.concatenate([corners, clicks[:, :2]])
    labels = np.concatenate([[2, 3][: len(corners)], clicks[:, 2]])
    return input_points(pixels, shape, side), labels.astype(np.int64)


class Sam2:
    """A `Segmenter` with installed SAM 2 weights."""

    def __init__(self, name: str, folder: Path | None = None) -> None:
        """Load weights by their name, see `sam2_weights`.

        Raises:
            BackendError: The extra is missing, or the weights are missing or damaged.
        """
        self._network = load_pretrained("sam2", "Sam2Model", find_sam2(name, folder))

    def prepare(self, name: str, image_srgb: NDArray[np.uint8]) -> PreparedImage:
        """Encode an image; see `Segmenter`."""
        import torch

        values = torch.from_numpy(pixel_values(image_srgb, input_side(self._network))[None])
        embeddings = self._network.get_image_embeddings(values)
        height, width = image_srgb.shape[:2]
        return _Sam2Image(self._network, embeddings, (height, width))


class _Sam2Image:
    def __init__(self, network: Any, embeddings: Any, shape: tuple[int, int]) -> None:
        self.network, self.embeddings, self.shape = network, embeddings, shape

    def mask(self, part: str, box_px: ArrayLike, points: ArrayLike) -> Mask:
        coordinates, labels = input_prompt(box_px, points, self.shape, input_side(self.network))
        logits, _ = self._ask(coordinates[None], labels[None], several=False)
        large = masks_of_logits([logits[0, 0]], [1.0], self.shape)
        return clean(large.masks[0])

    def at_points(self, points_px: ArrayLike) -> PointMasks:
        """Compute three masks for each point: of a detail, a part and the whole object."""
        scaled = input_points(points_px, self.shape, input_side(self.network))
        masks, quality = [], []
        for start in range(0, len(scaled), _POINTS):
            some = scaled[start : start + _POINTS, None]
            logits, expected = self._ask(some, np.ones(some.shape[:2], np.int64), several=True)
            masks.extend(logits.reshape(-1, *logits.shape[2:]))
            quality.extend(expected.ravel())
        return masks_of_logits(masks, quality, self.shape)

    def _ask(
        self, coordinates: NDArray[np.float32], labels: NDArray[np.int64], *, several: bool
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compute scores (B, M, h, w) and expected IoUs (B, M) of B prompts (B, P, 2) with labels (B, P)."""
        import torch

        with torch.inference_mode():
            answer = self.network(
                image_embeddings=self.embeddings,
                input_points=torch.from_numpy(coordinates[None]),
                input_labels=torch.from_numpy(labels[None]),
                multimask_output=several,
            )
        return answer.pred_masks[0].float().cpu().numpy(), answer.iou_scores[0].float().cpu().numpy()


def load_tracker(folder: Path) -> Any:
    """Load the network that tracks parts, with the weights of a folder.

    Raises:
        BackendError: transformers is missing, or the weights lack those of the tracker.
    """
    return load_pretrained("sam2_video", "Sam2VideoModel", folder)


def carry_prompts(
    tracker: Any,
    names: Sequence[str],
    image_of: Callable[[str], NDArray[np.uint8]],
    prompts: Sequence[Prompt],
    progress: Progress,
) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Yield label images of a sequence with similar neighboring images, from prompts on some of them.

    Tracking begins at the first prompted image and proceeds to the end, then backward to the beginning.

    Args:
        tracker: See `load_tracker`.
        names: Images in the order in which they were taken.
        image_of: Function that reads an image (H, W, 3), sRGB.
        prompts: Boxes or points of "static" (the object) and "moving"; other parts are ignored.
        progress: Called for each image.

    Yields:
        Each name once, with its labels (H, W), see `conventions.PART_LABELS`.

    Raises:
        InputError: No prompt is on any of the images.
    """
    import torch

    tracks = []
    cache = None
    for part, value in PARTS:
        asked = [prompt for prompt in prompts if prompt.part == part and prompt.image in names]
        if asked:
            track = _Track(tracker, value, _Frames(tracker, names, image_of), cache)
            cache = track.session.cache
            tracks.append((track, asked))
    if not tracks:
        raise InputError("prompts", "none is on an image of the sequence", "prompt one of its images")
    with torch.inference_mode():
        for track, asked in tracks:
            for prompt in asked:
                track.start(names.index(prompt.image), prompt, image_of(prompt.image).shape)
        first = min(names.index(prompt.image) for _, asked in tracks for prompt in asked)
        order = [*range(first, len(names)), *range(first - 1, -1, -1)]
        for done, index in enumerate(order):
            shape = image_of(names[index]).shape[:2]
            labels = np.full(shape, BACKGROUND, np.uint8)
            for track, _ in tracks:
                labels[track.mask(index, shape, reverse=index < first)] = track.value
            progress((done + 1) / len(order), f"image {done + 1} of {len(order)}")
            yield names[index], labels


class _Frames:
    """Images of a sequence as inputs of the network, read at their first use."""

    def __init__(
        self, tracker: Any, names: Sequence[str], image_of: Callable[[str], NDArray[np.uint8]]
    ) -> None:
        self._side, self._names, self._image_of = input_side(tracker), names, image_of

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: int) -> Any:
        import torch

        return torch.from_numpy(pixel_values(self._image_of(self._names[index]), self._side))


class _Track:
    """Track of one part. All parts share the encoding of the last image."""

    def __init__(self, tracker: Any, value: int, frames: _Frames, cache: Any) -> None:
        module = transformers_module("models.sam2_video.modeling_sam2_video")
        self.value, self._tracker = value, tracker
        self.session = module.Sam2VideoInferenceSession(inference_device=tracker.device, dtype=tracker.dtype)
        self.session.processed_frames = frames
        if cache is not None:
            self.session.cache = cache
        self._index = self.session.obj_id_to_idx(value)

    def start(self, frame: int, prompt: Prompt, shape: tuple[int, ...]) -> None:
        """Start the track in an image; a box and points on it are one prompt."""
        import torch

        coordinates, labels = input_prompt(prompt.box, prompt.points, shape, input_side(self._tracker))
        asked = {
            "point_coords": torch.from_numpy(coordinates)[None, None],
            "point_labels": torch.from_numpy(labels)[None, None].int(),
        }
        self.session.add_point_inputs(self._index, frame, asked)
        self.session.obj_with_new_inputs = [self.value]
        self._tracker(self.session, frame_idx=frame)

    def mask(self, frame: int, shape: tuple[int, ...], *, reverse: bool) -> NDArray[np.bool_]:
        """Compute the mask (H, W) of the part in an image."""
        answer = self._tracker(self.session, frame_idx=frame, reverse=reverse)
        logits = answer.pred_masks[0, 0].float().cpu().numpy()
        return clean(masks_of_logits([logits], [1.0], shape).masks[0])
