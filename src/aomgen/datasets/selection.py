"""What a dataset is made of: committed episodes that are alike, their split, and the chosen form of their content."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from aomgen.datasets.features import ActionSpace
from aomgen.errors import ConfigError, MissingFileError
from aomgen.io.atomic import stage_folder, write_json
from aomgen.io.episode_folder import CommittedEpisode, read_episode

# How a LeRobot dataset stores pictures: compressed videos, or PNG in its tables, which need no video decoder; or none, and
# policies are told the object's pose instead: how well they could do if they saw perfectly.
Media = Literal["video", "image", "none"]
# Share of the episodes that validates where a format needs such a split and nobody says how many.
VAL_SHARE: Final = 0.1
# Beside a dataset's data: what it was made of. A folder without it is not ours to replace.
MARK: Final = "aomgen.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The form of a dataset.

    Attributes:
        actions: Space of the actions that policies learn.
        media: How LeRobot datasets store pictures.
        size: Width and height of pictures, [px]; None for as rendered.
        val: Number of episodes to validate on, in a split of their own.
    """

    actions: ActionSpace = "joint"
    media: Media = "video"
    size: tuple[int, int] | None = None
    val: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """The episodes of a dataset.

    Attributes:
        train, val: To train and to validate on. All have the same rate, robot, joints and cameras, and
            their cameras the dataset's picture size; videos and color counts are as rendered.
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
        """How many frames all of them have."""
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
            the split, or pictures are rendered smaller.
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
    if choices.size is not None:
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
        StorageError: The disk refuses.
    """
    with stage_folder(folder) as staging:
        yield staging
        indices = {
            name: [item.episode.index for item in episodes] for name, episodes in selection.splits.items()
        }
        write_json(staging / MARK, {"choices": asdict(selection.choices), "episodes": indices})


def require_replaceable(folder: Path) -> None:
    """Refuse a place where something else stands than a dataset of ours.

    Raises:
        ConfigError: It does.
    """
    empty = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    if not empty and not (folder / MARK).is_file():
        raise ConfigError(folder, f"is there and no dataset of AOMGen ({MARK})", "choose another folder")


def spread(count: int, wanted: int) -> set[int]:
    """That many of the numbers 0..count-1, evenly spread: every asset and range has its part in both splits."""
    return {int(number) for number in (np.arange(wanted) + 0.5) * count // max(wanted, 1)}


def default_val(episodes: int) -> int:
    """How many episodes validate where a format needs some: a tenth, at least one."""
    return max(1, round(VAL_SHARE * episodes))


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `128x96`, [px].

    Raises:
        ConfigError: It is not of that form.
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError("--size", f"'{text}' is not WxH", "want WxH as in 128x96, [px]")
    return int(width), int(height)


def require_smaller(size: tuple[int, int], drawn: tuple[int, int], what: str) -> None:
    """Refuse pictures larger than what is drawn, both width and height, [px].

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
                item.folder, f"has {name} {value}, {first.folder.name} has {want[name]}", "export them apart"
            )
