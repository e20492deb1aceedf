"""Segmenters that use MobileSAM, or label images on disk, and the choice of a segmenter; see also `sam2`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from aomgen.conventions import MOVING, PART_LABELS, STATIC
from aomgen.core.values import Array
from aomgen.errors import BackendError, MalformedFileError
from aomgen.io.images import read_labels
from aomgen.segmentation.interface import (
    Mask,
    PointMasks,
    PreparedImage,
    Segmenter,
    clean,
    masks_of_logits,
    wrap_masks,
)
from aomgen.segmentation.weights import ensure_weights

# Side of the network's input, [px], determined by its weights.
_SIDE: Final = 1024
_MEAN: Final = np.array([123.675, 116.28, 103.53], np.float32)
_SPREAD: Final = np.array([58.395, 57.12, 57.375], np.float32)


class MobileSam:
    """A `Segmenter` with MobileSAM's encoder and decoder in ONNX; encoding an image takes 2 to 3 s on two cores."""

    def __init__(self) -> None:
        """Load the weights.

        Raises:
            BackendError: onnxruntime is missing, or the weights are missing or damaged.
        """
        paths = ensure_weights("mobile_sam")
        try:
            import onnxruntime
        except ImportError as error:
            raise BackendError("onnxruntime", "is not installed", "pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        self._encoder, self._decoder = (
            onnxruntime.InferenceSession(paths[name], options, providers=["CPUExecutionProvider"])
            for name in ("encoder.onnx", "sam.onnx")
        )

    def prepare(self, name: str, image_srgb: NDArray[np.uint8]) -> "PreparedImage":
        """Encode an image; see `Segmenter`."""
        height, width = image_srgb.shape[:2]
        scale = _SIDE / max(height, width)
        size = (round(width * scale), round(height * scale))
        resized = np.asarray(Image.fromarray(image_srgb).resize(size, Image.Resampling.BILINEAR), np.float32)
        padded = np.zeros((1, 3, _SIDE, _SIDE), np.float32)
        padded[0, :, : size[1], : size[0]] = ((resized - _MEAN) / _SPREAD).transpose(2, 0, 1)
        embedding = np.asarray(self._encoder.run(None, {"input": padded})[0])
        return _EncodedImage(self._decoder, embedding, (height, width))


class _EncodedImage:
    def __init__(self, decoder: Any, embedding: NDArray[np.float32], shape: tuple[int, int]) -> None:
        self.decoder, self.embedding, self.shape = decoder, embedding, shape
        self.scale = _SIDE / max(shape)

    def mask(self, part: str, box_px: ArrayLike, points: ArrayLike) -> Mask:
        corners = np.asarray(box_px, np.float64).reshape(-1, 2)
        clicks = np.asarray(points, np.float64).reshape(-1, 3)
        # Labels of the decoder: 1 on the part, 0 outside, 2 and 3 corners of a box, -1 padding, which is required without a box.
        ends = np.array([2.0, 3.0]) if len(corners) else np.array([-1.0])
        corners = corners if len(corners) else np.zeros((1, 2))
        coords = np.concatenate([clicks[:, :2], corners]) * self.scale
        labels = np.concatenate([clicks[:, 2], ends])
        logits = self._ask(None, coords, labels)[0][0, 0]
        return clean(logits > 0)

    def at_points(self, points_px: ArrayLike) -> PointMasks:
        # The published decoder accepts one prompt per call; its low-resolution masks are sufficient here.
        logits, quality = [], []
        for point in np.asarray(points_px, np.float64).reshape(-1, 2):
            coords = np.array([point * self.scale, [0.0, 0.0]])
            expected, small = self._ask(["iou_predictions", "low_res_masks"], coords, np.array([1.0, -1.0]))
            height, width = (round(256 * side * self.scale / _SIDE) for side in self.shape)
            logits.append(small[0, 0, :height, :width])
            quality.append(expected[0, 0])
        return masks_of_logits(logits, quality, self.shape)

    def _ask(self, outputs: list[str] | None, coords: Array, labels: Array) -> list[NDArray[np.float32]]:
        """Compute outputs of the decoder for points (P, 2), in pixels of the network's input, with labels (P,)."""
        feeds = {
            "image_embeddings": self.embedding,
            "point_coords": coords[None].astype(np.float32),
            "point_labels": labels[None].astype(np.float32),
            "mask_input": np.zeros((1, 1, 256, 256), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array(self.shape, np.float32),
        }
        return self.decoder.run(outputs, feeds)


class MasksOnDisk:
    """A `Segmenter` with the label images of a capture, whose values are `PART_LABELS`.

    A label image is a PNG with the file name of the image, without its suffix.
    """

    def __init__(self, folders: Mapping[str, Path]) -> None:
        self.folders = folders

    def prepare(self, name: str, image_srgb: NDArray[np.uint8]) -> "PreparedImage":
        """Read the label image of one scan image; without label image, the whole image is background.

        Raises:
            MalformedFileError: The label image is malformed or has another size than the image.
        """
        labels = np.zeros(image_srgb.shape[:2], np.uint8)
        for folder in self.folders.values():
            path = folder / f"{Path(name).stem}.png"
            if path.is_file():
                labels = read_labels(path)
                break
        if labels.shape != image_srgb.shape[:2]:
            raise MalformedFileError(
                path, f"is {labels.shape[::-1]} px, its image is {image_srgb.shape[1::-1]}", "export it again"
            )
        return _LabelImage(labels)


class _LabelImage:
    def __init__(self, labels: NDArray[np.uint8]) -> None:
        self.labels = labels

    def mask(self, part: str, box_px: ArrayLike, points: ArrayLike) -> Mask:
        if part == "object":
            return (self.labels == STATIC) | (self.labels == MOVING)
        return self.labels == PART_LABELS[part]

    def at_points(self, points_px: ArrayLike) -> PointMasks:
        columns, rows = np.floor(np.asarray(points_px, np.float64).reshape(-1, 2)).astype(np.int64).T
        height, width = self.labels.shape
        values = self.labels[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        named = values[values > 0]
        return wrap_masks([self.labels == value for value in named], self.labels.shape)


def choose_segmenter(mask_folders: Mapping[str, Path], name: str = "auto") -> Segmenter:
    """Load the segmenter of a name; if it is missing, no other one is used instead.

    Args:
        mask_folders: Folders of label images of the capture, by name.
        name: "auto" (label images if the capture has any, else MobileSAM), "mobile_sam", or the name of installed SAM 2
            weights; see `sam2_weights`.

    Raises:
        BackendError: The weights or a package are missing; the message states the command that installs them.
    """
    if name == "auto" and mask_folders:
        return MasksOnDisk(folders=mask_folders)
    if name in ("auto", "mobile_sam"):
        return MobileSam()
    from aomgen.segmentation.sam2 import Sam2

    return Sam2(name)
