"""What is read back of a dataset of any format, to be compared with episodes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.datasets.features import ACTION_SPACES, ActionSpace
from aomgen.errors import MalformedFileError

REMEDY: Final = "export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredEpisode:
    """One episode of a dataset.

    Attributes:
        source_index: Number of the episode that it was made from.
        split: "train" or "val".
        instruction: Language instruction.
        columns: Values (T, D) or (T,) by feature.
        pictures: Frames (H, W, 3) uint8 by camera; to be taken before the next episode is.
    """

    source_index: int
    split: str
    instruction: str
    columns: Mapping[str, NDArray[Any]]
    pictures: Mapping[str, Iterator[NDArray[np.uint8]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredDataset:
    """A dataset that is being read.

    Attributes:
        actions: Space of the feature `action`.
        sizes: Width and height of the pictures by camera, [px].
        video: Whether pictures were compressed as videos are.
        pictures: Whether there are any.
        episodes: One after the other; what is wrong with a file is raised when it is reached.
    """

    actions: ActionSpace
    sizes: Mapping[str, tuple[int, int]]
    episodes: Iterator[StoredEpisode]
    video: bool = False
    pictures: bool = True


def chosen_space(features: Mapping[str, Any], where: Path) -> ActionSpace:
    """The action space that is no annotation.

    Raises:
        MalformedFileError: There is no such space, or more than one.
    """
    absent: list[ActionSpace] = [
        space for space in ACTION_SPACES if f"annotation.action.{space}" not in features
    ]
    if len(absent) != 1:
        known = (
            ", ".join(f"annotation.action.{space}" for space in absent) or "no action space but annotations"
        )
        raise MalformedFileError(
            where, f"lacks the features {known}, of which only one may be 'action'", REMEDY
        )
    return absent[0]
