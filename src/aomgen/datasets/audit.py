"""Compare the numbers, images and splits of a dataset with its episodes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.datasets.features import read_images
from aomgen.datasets.formats import DatasetFormat, find_format
from aomgen.datasets.selection import REMEDY, StoredDataset, StoredEpisode
from aomgen.errors import MalformedFileError
from aomgen.io.episode_folder import CommittedEpisode, read_episode
from aomgen.io.video import halve_colors
from aomgen.splatting.metrics import psnr

# Largest difference of a number, relative to the number or to 1; several steps of single precision.
MAX_DIFFERENCE: Final = 1e-6
# Smallest PSNR of an image relative to the episode, [dB]; JPEG of quality 95 and re-encoded videos are above.
MIN_PSNR_DB: Final = 35.0


@dataclass(slots=True)
class Audit:
    """Result of a comparison.

    Attributes:
        actions: Action space of the feature `action`.
        committed: Number of committed episodes.
        splits: Number of episodes in the dataset, by split.
        frames: Number of frames in the dataset.
        difference, differing: Largest difference of a number, and the feature with this difference.
        psnr_db, least_like: Smallest PSNR of an image, and the camera and episode of this image.
        faults: Sentences about differences; empty if dataset and episodes agree.
    """

    actions: str
    committed: int
    splits: dict[str, int] = field(default_factory=dict)
    frames: int = 0
    difference: float = 0.0
    differing: str = "none"
    psnr_db: float = np.inf
    least_like: str = "none"
    faults: list[str] = field(default_factory=list)


def audit_dataset(dataset: Path, episode_folders: Sequence[Path]) -> Audit:
    """Compare a dataset with committed episodes.

    Args:
        dataset: Folder of a dataset in any format of `FORMATS`.
        episode_folders: All committed episodes of a run.

    Raises:
        MissingFileError, MalformedFileError: A file of the dataset is missing, damaged, or lacks a feature.
        CorruptArtifactError: An episode's file is damaged.
    """
    kind = find_format(dataset)
    stored = kind.read(dataset)
    left = {int(folder.name): folder for folder in episode_folders}
    audit = Audit(actions=stored.actions, committed=len(left))
    for found in stored.episodes:
        audit.splits[found.split] = audit.splits.get(found.split, 0) + 1
        if found.source_index not in left:
            audit.faults.append(
                f"episode {found.source_index} is not committed, is rejected, or occurs twice"
            )
            continue
        item = read_episode(left.pop(found.source_index))
        cameras = {
            name: camera.resize(*stored.sizes.get(name, (camera.width, camera.height)))
            for name, camera in item.episode.cameras.items()
        }
        _compare_numbers(audit, kind, found, replace(item.episode, cameras=cameras), dataset)
        _compare_images(audit, stored, found, item)
        audit.frames += len(item.episode)
    if left:
        audit.faults.append(
            f"{len(left)} committed episodes are not in the dataset, the first is {min(left)}"
        )
    if kind.needs_val and set(audit.splits) != {"train", "val"}:
        audit.faults.append(f"has no split but {', '.join(audit.splits)}")
    return audit


def _compare_numbers(
    audit: Audit, kind: DatasetFormat, found: StoredEpisode, episode: Episode, dataset: Path
) -> None:
    number = f"{episode.index:06d}"
    if found.instruction != episode.instruction:
        audit.faults.append(f"episode {number} has the instruction '{found.instruction}'")
    for name, wanted in kind.columns(episode, audit.actions).items():  # type: ignore[arg-type]
        if name not in found.columns:
            raise MalformedFileError(dataset, f"lacks the feature '{name}' of episode {number}", REMEDY)
        values = np.reshape(found.columns[name], (len(found.columns[name]), -1))
        wanted = np.reshape(wanted, (len(wanted), -1))
        if values.shape != wanted.shape:
            audit.faults.append(f"'{name}' of episode {number} has shape {values.shape}, not {wanted.shape}")
            continue
        difference = float(np.max(np.abs(values - wanted) / np.maximum(1, np.abs(wanted))))
        if not difference <= MAX_DIFFERENCE:
            audit.faults.append(f"'{name}' of episode {number} differs by {difference:.2g}")
        if not difference <= audit.difference:
            audit.difference, audit.differing = difference, name


def _compare_images(
    audit: Audit, stored: StoredDataset, found: StoredEpisode, item: CommittedEpisode
) -> None:
    number = item.folder.name
    if set(found.images) != (set(item.episode.cameras) if stored.images else set()):
        audit.faults.append(f"episode {number} has cameras {sorted(found.images)}")
        return
    for camera, images in found.images.items():
        likeness = list(_likenesses(images, _render_reference(stored, item, camera)))
        least = min(likeness, default=0.0)
        if len(likeness) != len(item.episode) or not least >= MIN_PSNR_DB:
            audit.faults.append(
                f"camera '{camera}' of episode {number} shows {len(likeness)} frames of {len(item.episode)}, "
                f"with a lowest PSNR of {least:.1f} dB, limit {MIN_PSNR_DB:.0f} dB"
            )
        if least < audit.psnr_db:
            audit.psnr_db, audit.least_like = least, f"{camera} of episode {number}"


def _render_reference(
    stored: StoredDataset, item: CommittedEpisode, camera: str
) -> Iterator[NDArray[np.uint8]]:
    """Yield images of an episode with the dataset's resolution and color sampling."""
    rendered = item.episode.cameras[camera]
    view = rendered.resize(*stored.sizes[camera])
    again = stored.video and (view.width, view.height) != (rendered.width, rendered.height)
    cameras = {**item.episode.cameras, camera: view}
    for image in read_images(replace(item, episode=replace(item.episode, cameras=cameras)), camera):
        yield halve_colors(image) if again else image


def _likenesses(images: Iterator[NDArray[np.uint8]], wanted: Iterator[NDArray[np.uint8]]) -> Iterator[float]:
    """Yield the PSNR of each pair of frames, [dB]; infinite for equal frames, 0 for different shapes."""
    for mine, theirs in zip(images, wanted, strict=False):
        if np.array_equal(mine, theirs):
            yield np.inf
        else:
            yield psnr(mine / 255, theirs / 255) if mine.shape == theirs.shape else 0.0
