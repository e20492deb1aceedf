"""Masks of everything in an image, from a grid of points. [paper 4.1]

Every grid point asks the segmenter what lies under it; answers that are doubtful, tiny, nearly the
whole image or a repetition of a better one are dropped (as in Segment Anything, Kirillov et al., 2023,
sec. 4). A view's masks are stored as soon as they are found, so that a killed run goes on where it was.
"""

import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze
from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_bytes
from aomgen.segmentation.interface import Mask, PointMasks

# Least IoU that the segmenter expects of its answer; the default of SAM 2's mask generator.
MIN_QUALITY = 0.8
# Least IoU between tighter and looser cut of a mask: the same limit.
MIN_STABILITY = 0.8
# Least share of the image that a mask covers: below it a mask is a speck.
MIN_SHARE = 0.0005
# Largest share: above it a mask is the image.
MAX_SHARE = 0.9
# IoU above which two masks are the same thing.
MAX_OVERLAP = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewMasks:
    """Masks found in one view, best first; they may overlap and contain one another.

    Attributes:
        masks: (M, H, W).
        scores: (M,), expected IoU times stability.
    """

    masks: NDArray[np.bool_]
    scores: NDArray[np.float32]

    def __post_init__(self) -> None:
        freeze(self, "masks", self.masks, (len(self.masks), None, None), np.bool_)
        freeze(self, "scores", self.scores, (len(self.masks),), np.float32)


def grid_points(shape: tuple[int, ...], side: int, skip: Mask | None = None) -> Array:
    """Centres (N, 2), [px], of a side x side division of an image (H, W), without those on `skip`."""
    steps = (np.arange(side) + 0.5) / side
    points = np.stack(np.meshgrid(steps * shape[1], steps * shape[0]), -1).reshape(-1, 2)
    if skip is None:
        return points
    columns, rows = np.floor(points).astype(int).T
    return points[~skip[rows, columns]]


def best_masks(answers: PointMasks, known: Mask | None = None) -> ViewMasks:
    """The good ones among many answers, best first, none of them twice."""
    masks = answers.masks if known is None else answers.masks & ~known
    if not len(masks):
        return ViewMasks(masks=masks, scores=answers.quality)
    shares = masks.mean((1, 2))
    scores = answers.quality * answers.stability
    good = (answers.quality >= MIN_QUALITY) & (answers.stability >= MIN_STABILITY)
    good &= (shares >= MIN_SHARE) & (shares <= MAX_SHARE)
    # Every fourth row and column tells overlaps well enough, and sixteen times faster.
    small = masks[:, 1::4, 1::4].reshape(len(masks), -1).astype(np.float32)
    shared, areas = small @ small.T, small.sum(1)
    overlaps = shared / np.maximum(areas[:, None] + areas - shared, 1)
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if good[index] and np.all(overlaps[index, kept] <= MAX_OVERLAP):
            kept.append(int(index))
    return ViewMasks(masks=masks[kept], scores=scores[kept])


def masks_of_views(
    names: Sequence[str],
    find: Callable[[str], ViewMasks],
    folder: Path | None,
    progress: Progress,
) -> Mapping[str, ViewMasks]:
    """Masks by view, those found earlier read back from the folder.

    Args:
        names: Views to look at.
        find: Finds the masks of one view.
        folder: Holds one file a view; None keeps nothing. It must belong to these views, this
            segmenter and these parameters: nothing here compares them.
        progress: Called about each view.

    Raises:
        MalformedFileError: A stored file is damaged.
    """
    found = {}
    for index, name in enumerate(names):
        stored = load_stored_masks(folder, name)
        found[name] = find(name) if stored is None else stored
        if folder is not None and stored is None:
            save_masks(_file_of(folder, name), found[name])
        count = len(found[name].masks)
        progress((index + 1) / len(names), f"{count} masks in view {index + 1} of {len(names)}")
    return found


def load_stored_masks(folder: Path | None, name: str) -> ViewMasks | None:
    """Masks of a view that an earlier run left in the folder, or None.

    Raises:
        MalformedFileError: The file is damaged.
    """
    if folder is None or not _file_of(folder, name).is_file():
        return None
    return load_masks(_file_of(folder, name))


def _file_of(folder: Path, name: str) -> Path:
    return folder / f"{Path(name).stem}.npz"


def save_masks(path: Path, item: ViewMasks) -> None:
    """Write the masks of one view, eight pixels a byte."""
    buffer = io.BytesIO()
    packed = np.packbits(item.masks, axis=-1)
    np.savez_compressed(buffer, packed=packed, width=item.masks.shape[2], scores=item.scores)
    write_bytes(path, buffer.getvalue())


def load_masks(path: Path) -> ViewMasks:
    """Read what `save_masks` wrote.

    Raises:
        MalformedFileError: The file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            masks = np.unpackbits(arrays["packed"], axis=-1, count=int(arrays["width"]))
            return ViewMasks(masks=masks.astype(bool), scores=arrays["scores"])
    except (ValueError, KeyError, OSError, TypeError, zipfile.BadZipFile) as error:
        raise MalformedFileError(path, f"does not hold masks ({error})", "delete it") from error
