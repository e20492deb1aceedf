"""Content of a dataset: compatible committed episodes, their splits, and the options of the dataset."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from aomgen.datasets.features import ACTION_SPACES, TOLD_FEATURES, ActionSpace
from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.io.atomic import is_vacant, stage_folder, write_json
from aomgen.io.episode_folder import CommittedEpisode, read_episode

# Storage of images in a LeRobot dataset: compressed videos, or PNG in its tables, which requires no video decoder. With
# "none" or "keypoints", policies observe the object's pose or its keypoints instead of images.
Media = Literal["video", "image", "none", "keypoints"]
# Default share of the validation episodes in formats that need such a split.
VAL_SHARE: Final = 0.1
# File in a dataset that names its source. Folders without it are never replaced.
MARK: Final = "aomgen.json"
REMEDY: Final = "export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """Options of a dataset.

    Attributes:
        actions: Action space that policies learn.
        media: Storage of the images in LeRobot datasets.
        size: Width and height of images, [px]; None keeps the rendered size.
        val: Number of episodes in the validation split.
    """

    actions: ActionSpace = "joint"
    media: Media = "video"
    size: tuple[int, int] | None = None
    val: int = 0

    @property
    def has_images(self) -> bool:
        """Return whether images are stored."""
        return self.media not in TOLD_FEATURES


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """The episodes of a dataset.

    Attributes:
        train, val: Training and validation episodes with equal rate, robot, joints and cameras. The cameras have the
            image size of the dataset; videos and color counts are those of the rendered images.
        choices: Options of the dataset.
    """

    train: tuple[CommittedEpisode, ...]
    val: tuple[CommittedEpisode, ...]
    choices: Choices

    @property
    def episodes(self) -> tuple[CommittedEpisode, ...]:
        """Return all episodes, the training split first."""
        return self.train + self.val

    @property
    def splits(self) -> dict[str, tuple[CommittedEpisode, ...]]:
        """Return the two splits by name."""
        return {"train": self.train, "val": self.val}

    @property
    def frames(self) -> int:
        """Return the number of frames of all episodes."""
        return sum(len(item.episode) for item in self.episodes)


def select_episodes(episode_folders: Sequence[Path], dataset: Path, choices: Choices) -> Selection:
    """Read the episodes of a dataset, in the given order.

    Args:
        episode_folders: Folders that `io.episode_folder.commit_episode` wrote.
        dataset: Folder of the dataset, for messages.
        choices: Options of the dataset.

    Raises:
        MissingFileError: There is no episode.
        ConfigError: Episodes differ in rate, robot, joints, cameras or codec, there are too few for the split, or the
            rendered images are too small.
        CorruptArtifactError: An episode's file is damaged.
    """
    if not episode_folders:
        raise MissingFileError(dataset, "there is no episode to write", "generate episodes first")
    if not 0 <= choices.val < len(episode_folders):
        raise ConfigError(
            "--val",
            f"{choices.val} of {len(episode_folders)} episodes leaves none to train on",
            "choose fewer, or generate more",
        )
    episodes = [read_episode(path) for path in episode_folders]
    for item in episodes:
        _check_alike(item, episodes[0])
    # Without images, keypoints are in pixels of the rendered images.
    if choices.size is not None and choices.has_images:
        episodes = [_resize_cameras(item, choices.size) for item in episodes]
    chosen = spread(len(episodes), choices.val)
    return Selection(
        train=tuple(item for number, item in enumerate(episodes) if number not in chosen),
        val=tuple(episodes[number] for number in sorted(chosen)),
        choices=choices,
    )


@contextmanager
def stage_dataset(folder: Path, selection: Selection) -> Iterator[Path]:
    """Yield a marked folder that becomes the dataset when the block ends without an error.

    Raises:
        StorageError: Writing to the disk failed.
    """
    with stage_folder(folder) as staging:
        yield staging
        indices = {
            name: [item.episode.index for item in episodes] for name, episodes in selection.splits.items()
        }
        write_json(staging / MARK, {"choices": asdict(selection.choices), "episodes": indices})


def require_replaceable(folder: Path) -> None:
    """Refuse a folder that AOMGen did not write.

    Raises:
        ConfigError: The folder has other content.
    """
    if not is_vacant(folder) and not (folder / MARK).is_file():
        raise ConfigError(
            folder, f"exists and was not written by AOMGen (no {MARK})", "choose another folder"
        )


def spread(count: int, wanted: int) -> set[int]:
    """Choose `wanted` of the numbers 0..count-1, evenly spaced, so that both splits contain all assets and ranges."""
    return {int(number) for number in (np.arange(wanted) + 0.5) * count // max(wanted, 1)}


def default_val(episodes: int) -> int:
    """Return the default number of validation episodes: 10 %, at least one."""
    return max(1, round(VAL_SHARE * episodes))


def choose_shard(episode_folders: Sequence[Path], shard: str) -> list[Path]:
    """Choose the episodes of a shard, "i/n" with i from 1 to n: every n-th episode from the i-th on.

    Every shard contains all assets and ranges, and n shards together contain every episode once.

    Raises:
        ConfigError: The text has another form, or the shard has no episode.
    """
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise ConfigError("--shard", f"'{shard}' is not i/n", "expected i/n with i from 1 to n, as in 2/8")
    chosen = list(episode_folders[int(number) - 1 :: int(count)])
    if not chosen:
        raise ConfigError(
            "--shard", f"{shard} of {len(episode_folders)} episodes has no episode", "choose fewer shards"
        )
    return chosen


def shard_name(shard: str) -> str:
    """Return the name of the folder of a shard "i/n", which is valid in all formats; RLDS does not allow hyphens."""
    number, _, count = shard.partition("/")
    return f"part_{int(number)}_of_{int(count)}"


def parse_size(text: str) -> tuple[int, int]:
    """Parse a width and height such as `128x96`, [px].

    Raises:
        ConfigError: The text has another form.
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError("--size", f"'{text}' is not WxH", "expected WxH as in 128x96, [px]")
    return int(width), int(height)


def require_smaller(size: tuple[int, int], drawn: tuple[int, int], what: str) -> None:
    """Refuse images that are wider or higher than the rendered ones, sizes in [px].

    Raises:
        ConfigError: The images are larger.
    """
    if not (size[0] <= drawn[0] and size[1] <= drawn[1]):
        raise ConfigError(
            "--size",
            f"{size[0]}x{size[1]} is larger than {what}, {drawn[0]}x{drawn[1]}",
            "choose a smaller one",
        )


def _resize_cameras(item: CommittedEpisode, size: tuple[int, int]) -> CommittedEpisode:
    for name, camera in item.episode.cameras.items():
        require_smaller(size, (camera.width, camera.height), f"what camera '{name}' rendered")
    cameras = {name: camera.resize(*size) for name, camera in item.episode.cameras.items()}
    return replace(item, episode=replace(item.episode, cameras=cameras))


def _check_alike(item: CommittedEpisode, first: CommittedEpisode) -> None:
    def kind(committed: CommittedEpisode) -> dict[str, Any]:
        episode = committed.episode
        sizes = {name: (camera.width, camera.height) for name, camera in sorted(episode.cameras.items())}
        return {
            "fps": episode.fps,
            "robot": episode.robot,
            "joints": episode.joint_names,
            "cameras": sizes,
            "codec": committed.codec,
        }

    have, want = kind(item), kind(first)
    for name, value in have.items():
        if value != want[name]:
            raise ConfigError(
                item.folder,
                f"has {name} {value}, {first.folder.name} has {want[name]}",
                "export them to separate datasets",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredEpisode:
    """One episode of a dataset.

    Attributes:
        source_index: Number of the source episode in its run.
        split: "train" or "val".
        instruction: Language instruction.
        columns: Values (T, D) or (T,) by feature.
        images: Frames (H, W, 3) uint8 by camera; must be read before the next episode.
    """

    source_index: int
    split: str
    instruction: str
    columns: Mapping[str, NDArray[Any]]
    images: Mapping[str, Iterator[NDArray[np.uint8]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredDataset:
    """A dataset that is opened for reading.

    Attributes:
        actions: Action space of the feature `action`.
        sizes: Width and height of the images by camera, [px].
        video: Whether images are compressed as videos.
        images: Whether the dataset contains images.
        episodes: Iterator of the episodes; errors in a file are raised when it is read.
    """

    actions: ActionSpace
    sizes: Mapping[str, tuple[int, int]]
    episodes: Iterator[StoredEpisode]
    video: bool = False
    images: bool = True


def chosen_space(features: Mapping[str, Any], where: Path) -> ActionSpace:
    """Return the action space that is not an annotation.

    Raises:
        MalformedFileError: There is no such space, or more than one.
    """
    absent: list[ActionSpace] = [
        space for space in ACTION_SPACES if f"annotation.action.{space}" not in features
    ]
    if not absent:
        raise MalformedFileError(
            where, "states all action spaces as annotations, so `action` has no space", REMEDY
        )
    if len(absent) > 1:
        known = " and ".join(f"annotation.action.{space}" for space in absent)
        raise MalformedFileError(where, f"lacks {known}; only the space of `action` may be missing", REMEDY)
    return absent[0]
