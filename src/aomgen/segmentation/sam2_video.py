"""Prompts carried from a few images to all of a sequence, with SAM 2's memory of what a part looks like.

Source: Ravi et al., SAM 2: Segment Anything in Images and Videos, 2024, through `transformers`.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import BACKGROUND, MOVING, STATIC
from aomgen.core.progress import Progress
from aomgen.core.recording import Prompt
from aomgen.errors import InputError
from aomgen.segmentation.interface import clean, masks_of_logits
from aomgen.segmentation.sam2 import (
    input_prompt,
    input_side,
    load_pretrained,
    pixel_values,
    transformers_module,
)
from aomgen.segmentation.sam2_weights import Sam2Files

# What lies on top comes last: the moving part lies on the prompted object.
PARTS = (("static", STATIC), ("moving", MOVING))


def load_tracker(files: Sam2Files, device: str = "cpu") -> Any:
    """The network that follows parts.

    Raises:
        BackendError: transformers is missing, or the weights have no memory.
    """
    return load_pretrained("sam2_video", "Sam2VideoModel", files, device)


def carry_prompts(
    tracker: Any,
    names: Sequence[str],
    image_of: Callable[[str], NDArray[np.uint8]],
    prompts: Sequence[Prompt],
    progress: Progress,
) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Label images of a sequence whose neighbors look alike, from prompts on some of it.

    Starts at the first prompted image, goes on to the end and then back to the beginning.

    Args:
        tracker: See `load_tracker`.
        names: Images in the order in which the camera saw them.
        image_of: Reads an image (H, W, 3), sRGB.
        prompts: Boxes or points of "static" (the object) and "moving"; other parts are not followed.
        progress: Called about each image.

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
    """Images of a sequence as the network sees them, read when they are asked for."""

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
    """One part, followed. Parts share the last image's encoding."""

    def __init__(self, tracker: Any, value: int, frames: _Frames, cache: Any) -> None:
        module = transformers_module("models.sam2_video.modeling_sam2_video")
        self.value, self._tracker = value, tracker
        self.session = module.Sam2VideoInferenceSession(inference_device=tracker.device, dtype=tracker.dtype)
        self.session.processed_frames = frames
        if cache is not None:
            self.session.cache = cache
        self._index = self.session.obj_id_to_idx(value)

    def start(self, frame: int, prompt: Prompt, shape: tuple[int, ...]) -> None:
        """Show the part in an image; a box on it and points on it are one prompt."""
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
        """Mask (H, W) of the part in an image."""
        answer = self._tracker(self.session, frame_idx=frame, reverse=reverse)
        logits = answer.pred_masks[0, 0].float().cpu().numpy()
        return clean(masks_of_logits([logits], [1.0], shape).masks[0])
