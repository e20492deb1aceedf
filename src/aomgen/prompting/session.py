"""Session in which a person marks robot and object parts on scan images: prompts, masks and missing prompts."""

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.assets.choice import MAKERS, OTHER_MAKERS
from aomgen.capture.capture_schema import PromptSection, read_manifest
from aomgen.capture.manifest_text import PLACEHOLDER
from aomgen.capture.prompts import PARTS, check_prompt, list_boxed_images
from aomgen.capture.read import measure_scan
from aomgen.capture.scan_images import find_images
from aomgen.core.recording import CAPTURE_FILE
from aomgen.errors import BackendError
from aomgen.io.paths import resolve_inside
from aomgen.prompting.prompts_file import save_prompts
from aomgen.prompting.scan_choice import ScanImages, propose_images
from aomgen.segmentation.interface import Mask, PreparedImage, Segmenter, bound_mask
from aomgen.segmentation.segmenter import choose_segmenter

# Required images per part; with two, a run continues if the camera of one of them is not found.
WANTED_IMAGES: Final = 2
# Margin of a box around a mask, [px]; masks end slightly inside the part.
MARGIN_PX: Final = 2.0


class PromptSession:
    """Prompts of one capture while a person edits them.

    Attributes:
        capture: Folder with a capture.toml.
        images: Images of the scan.
        size: Width and height of the images, [px].
        prompts: The last saved prompts.
        stated: Last saved category of the object and language instruction; "" if they are missing.
        no_masks: Reason for which masks are not available; empty if they are.
    """

    def __init__(self, capture: Path) -> None:
        """Read the capture's manifest and scan; prompts need not be complete yet.

        Raises:
            InputError: The capture has no valid capture.toml or no readable scan.
        """
        self._file = capture / CAPTURE_FILE
        manifest = read_manifest(self._file)
        scan = resolve_inside(capture, manifest.scan.images, named_by=self._file)
        video = scan if scan.is_file() else None
        images = () if video else find_images(scan)
        self.size, self._names = measure_scan(images, video)
        self.capture, self.images, self.prompts = capture, ScanImages(images, video), manifest.prompts
        stated = {"category": manifest.category, "instruction": manifest.instruction}
        self.stated = {key: "" if value == PLACEHOLDER else value for key, value in stated.items()}
        self.no_masks = ""
        try:
            self._segmenter: Segmenter | None = choose_segmenter({}, "mobile_sam")
        except BackendError as error:
            self._segmenter, self.no_masks = None, str(error)
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="encode")
        self._lock = threading.Lock()
        self._encoded: dict[int, Future[PreparedImage]] = {}

    def describe(self) -> dict[str, Any]:
        """Return the values of the page: image names, size, proposed images, prompts, and `no_masks`."""
        return {
            "capture": self.capture.name,
            "images": self.images.names,
            "blurs": [round(float(value), 3) for value in self.images.blurs],
            "proposed": propose_images(self.images.blurs),
            "size": list(self.size),
            "parts": list(PARTS),
            "wanted_images": WANTED_IMAGES,
            "stated": self.stated,
            "categories": sorted(MAKERS | OTHER_MAKERS),
            "prompts": [prompt.model_dump() for prompt in self.prompts],
            "no_masks": self.no_masks,
        }

    def encode(self, index: int) -> "Future[PreparedImage] | None":
        """Start to encode an image if it is not encoded yet; return None without a segmenter."""
        segmenter = self._segmenter
        if segmenter is None:
            return None
        with self._lock:
            if index not in self._encoded:
                name = self.images.names[index]
                self._encoded[index] = self._pool.submit(
                    lambda: segmenter.prepare(name, self.images.read(index))
                )
            return self._encoded[index]

    def segment(
        self, index: int, part: str, points: Sequence[Sequence[float]], box: Sequence[float]
    ) -> Mask | None:
        """Compute the mask (H, W) of a prompt; None without a segmenter, or if points and box mark nothing.

        Args:
            index: Index of the image.
            part: One of `PARTS`.
            points: Rows of x, y [px] and 1 on the part or 0 outside.
            box: Box x0, y0, x1, y1 [px], or empty.
        """
        encoded = self.encode(index)
        if encoded is None or not (len(box) or any(row[2] == 1 for row in points)):
            return None
        return encoded.result().mask(
            part, np.array(box, np.float64), np.array(points, np.float64).reshape(-1, 3)
        )

    def save(self, prompts: Sequence[PromptSection], stated: Mapping[str, str]) -> None:
        """Check all prompts, and write them and the stated values to capture.toml, also if prompts are missing.

        Proposals become confirmed prompts.

        Raises:
            InputError: A prompt is invalid; nothing is written.
        """
        prompts = [prompt.model_copy(update={"proposed": False, "confidence": None}) for prompt in prompts]
        for prompt in prompts:
            check_prompt(prompt, self._names, self.size, self._file)
        known = {key: value.strip() or PLACEHOLDER for key, value in stated.items()}
        save_prompts(self._file, prompts, known)
        self.prompts, self.stated = list(prompts), dict(stated)


def find_missing(prompts: Sequence[PromptSection]) -> dict[str, int]:
    """Count the images on which each part still needs a box; complete parts are omitted.

    Example:
        >>> find_missing([PromptSection(part="robot", image="0.jpg", box=[0, 0, 9, 9])])
        {'robot': 1, 'static': 2, 'moving': 2}
    """
    boxed = list_boxed_images(prompts)
    return {part: WANTED_IMAGES - len(found) for part, found in boxed.items() if len(found) < WANTED_IMAGES}


def box_of_mask(mask: NDArray[np.bool_]) -> list[float]:
    """Compute the box x0, y0, x1, y1 [px] of a mask (H, W) with a margin, inside the image; empty for an empty mask.

    Example:
        >>> mask = np.zeros((40, 60), bool)
        >>> mask[10:20, 30:50] = True
        >>> box_of_mask(mask)
        [28.0, 8.0, 52.0, 22.0]
    """
    if not mask.any():
        return []
    height, width = mask.shape
    margin = [-MARGIN_PX, -MARGIN_PX, MARGIN_PX, MARGIN_PX]
    return np.clip(bound_mask(mask) + margin, 0, [width, height, width, height]).tolist()
