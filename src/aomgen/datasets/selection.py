"""Content of a dataset: committed episodes of one kind, their split, and the chosen form."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from aomgen.datasets.features import ACTION_SPACES, TOLD_FEATURES, ActionSpace
from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.io.atomic import stage_folder, write_json
from aomgen.io.episode_folder import CommittedEpisode, read_episode

# Storage of images in a LeRobot dataset: compressed videos, or PNG in its tables, which need no video decoder; or none, and
# policies observe the object's pose or its keypoints instead.
Media = Literal["video", "image", "none", "keypoints"]
# Default share of the validation episodes in formats that need such a split.
VAL_SHARE: Final = 0.1
# Beside a dataset's data: what it was made of. A folder without it is not ours to replace.
MARK: Final = "aomgen.json"
REMEDY: Final = "export it again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The form of a dataset.

    Attributes:
        actions: Space of the actions that policies learn.
        media: Storage of the images in LeRobot datasets.
        size: Width and height of images, [px]; None for as rendered.
        val: Number of episodes to validate on, in a split of their own.
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
        train, val: To train and to validate on. All have the same rate, robot, joints and cameras, and
            their cameras the dataset's image size; videos and color counts are as rendered.
        choices: The form of the dataset.
    """

    train: tuple[CommittedEpisode, ...]
    val: tuple[CommittedEpisode, ...]
    choices: Choices

    @property
    def episodes(self) -> tuple[CommittedEpisode, ...]:
        """All of them, those to train on first."""
        return self.train + self.val

    @property
    def splits(self) -> dict[str, tuple[CommittedEpisode, ...]]:
        """The two splits by name."""
        return {"train": self.train, "val": self.val}

    @property
    def frames(self) -> int:
        """Number of frames of all episodes."""
        return sum(len(item.episode) for item in self.episodes)


def select_episodes(episode_folders: Sequence[Path], dataset: Path, choices: Choices) -> Selection:
    """Read the episodes of a dataset, in the order given.

    Args:
        episode_folders: Folders that `io.episode_folder.commit_episode` wrote.
        dataset: Folder of the dataset, for messages.
        choices: The form of the dataset.

    Raises:
        MissingFileError: There is no episode.
        ConfigError: Episodes differ in rate, robot, joints, cameras or codec; or there are too few for
            the split, or images are rendered smaller.
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
    # Without images, keypoints are in pixels of the rendered ones.
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
    """A folder that becomes the dataset when the block ends without an error, marked as ours.

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
    """Refuse a folder that holds something else than a dataset of ours.

    Raises:
        ConfigError: It does.
    """
    empty = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not empty and not (folder / MARK).is_file():
        raise ConfigError(folder, f"exists and is not a dataset of AOMGen ({MARK})", "choose another folder")


def spread(count: int, wanted: int) -> set[int]:
    """That many of the numbers 0..count-1, evenly spread: every asset and range has its part in both splits."""
    return {int(number) for number in (np.arange(wanted) + 0.5) * count // max(wanted, 1)}


def default_val(episodes: int) -> int:
    """Default number of validation episodes: a tenth, at least one."""
    return max(1, round(VAL_SHARE * episodes))


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `128x96`, [px].

    Raises:
        ConfigError: It is not of that form.
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError("--size", f"'{text}' is not WxH", "expected WxH as in 128x96, [px]")
    return int(width), int(height)


def require_smaller(size: tuple[int, int], drawn: tuple[int, int], what: str) -> None:
    """Refuse images larger than the rendered ones, both width and height, [px].

    Raises:
        ConfigError: They are.
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
        source_index: Number of the episode that it was made from.
        split: "train" or "val".
        instruction: Language instruction.
        columns: Values (T, D) or (T,) by feature.
        images: Frames (H, W, 3) uint8 by camera; to be read before the next episode.
    """

    source_index: int
    split: str
    instruction: str
    columns: Mapping[str, NDArray[Any]]
    images: Mapping[str, Iterator[NDArray[np.uint8]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredDataset:
    """A dataset that is being read.

    Attributes:
        actions: Space of the feature `action`.
        sizes: Width and height of the images by camera, [px].
        video: Whether images were compressed as videos are.
        images: Whether there are any.
        episodes: One after the other; what is wrong with a file is raised when it is reached.
    """

    actions: ActionSpace
    sizes: Mapping[str, tuple[int, int]]
    episodes: Iterator[StoredEpisode]
    video: bool = False
    images: bool = True


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
