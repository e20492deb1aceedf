"""Formats of datasets, and recognition of the format of a folder."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

from numpy.typing import NDArray

from aomgen.core.episode import Episode
from aomgen.core.progress import Progress, silent
from aomgen.datasets.features import ActionSpace, feature_columns
from aomgen.datasets.lerobot_reading import INFO_FILE, read_lerobot
from aomgen.datasets.lerobot_tables import single_precision_columns
from aomgen.datasets.lerobot_v3 import write_lerobot_v3
from aomgen.datasets.lerobot_v21 import write_lerobot_v21
from aomgen.datasets.rlds import FEATURES_FILE, openvla_columns, read_rlds, write_rlds
from aomgen.datasets.robomimic import FILE, read_robomimic, write_robomimic
from aomgen.datasets.selection import (
    MARK,
    Choices,
    Media,
    Selection,
    StoredDataset,
    choose_shard,
    default_val,
    parse_size,
    require_replaceable,
    shard_name,
)
from aomgen.errors import AomgenError, ConfigError, MalformedFileError, MissingFileError, UnknownNameError
from aomgen.io.artifact import MAX_LIST_BYTES, read_json
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.reuse import reuse
from aomgen.io.review import read_content
from aomgen.version import __version__

# Folder with the request of each shard of an export, which is written when the shard is complete.
SHARDS_FOLDER: Final = "shards"


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetFormat:
    """Format of datasets.

    Attributes:
        mark: File by which a folder in this format is recognized.
        write: Writes a dataset from episodes.
        read: Reads a dataset.
        columns: Computes the values of one episode by feature.
        actions: Default action space of `action`.
        media: Whether the storage of images can be chosen.
        needs_val: Whether the dataset needs a validation split.
    """

    mark: str
    write: Callable[[Sequence[Path], Path, Choices, Progress], Selection]
    read: Callable[[Path], StoredDataset]
    columns: Callable[[Episode, ActionSpace], Mapping[str, NDArray[Any]]]
    actions: ActionSpace = "joint"
    media: bool = False
    needs_val: bool = True


_LEROBOT: Final = DatasetFormat(
    mark=INFO_FILE,
    write=write_lerobot_v3,
    read=read_lerobot,
    columns=single_precision_columns,
    media=True,
    needs_val=False,
)
_RLDS: Final = DatasetFormat(
    mark=FEATURES_FILE, write=write_rlds, read=read_rlds, columns=openvla_columns, actions="ee_delta"
)
FORMATS: Final[dict[str, DatasetFormat]] = {
    "lerobot-v3": _LEROBOT,
    "lerobot-v2.1": replace(_LEROBOT, write=write_lerobot_v21),
    "rlds": _RLDS,
    "rlds-array-record": replace(_RLDS, write=partial(write_rlds, kind="array_record")),
    "hdf5": DatasetFormat(mark=FILE, write=write_robomimic, read=read_robomimic, columns=feature_columns),
}


def export_dataset(
    episode_folders: Sequence[Path],
    folder: Path,
    kind: str,
    progress: Progress = silent,
    *,
    actions: str = "",
    media: str = "",
    size: str = "",
    val: int | None = None,
) -> Selection:
    """Build a dataset from committed episodes; missing options have the defaults of the format.

    Args:
        episode_folders: Folders of committed episodes, in order.
        folder: Folder of the dataset; an existing dataset of AOMGen is replaced.
        kind: One of `FORMATS`.
        progress: Called with the progress.
        actions, media, val: See `selection.Choices`.
        size: Size of the images, for example `128x96`.

    Raises:
        ConfigError: An option is invalid, or the folder is not a dataset of AOMGen.
        AomgenError: Any error of the format's writer.
    """
    known = _format(kind)
    if media and not known.media:
        raise ConfigError("--media", f"has no meaning for {kind}", "it is for LeRobot; leave it out")
    for option, word, words in (("--actions", actions, ActionSpace), ("--media", media, Media)):
        if word and word not in get_args(words):
            raise UnknownNameError(option, word, get_args(words))
    default = default_val(len(episode_folders)) if known.needs_val else 0
    choices = Choices(
        actions=actions or known.actions,  # type: ignore[arg-type]
        media=media or "video",  # type: ignore[arg-type]
        size=parse_size(size) if size else None,
        val=default if val is None else val,
    )
    require_replaceable(folder)
    return known.write(episode_folders, folder, choices, progress)


def export_shard(
    episode_folders: Sequence[Path],
    folder: Path,
    kind: str,
    shard: str,
    progress: Progress = silent,
    **options: Any,
) -> Selection | None:
    """Build one of several datasets that together contain all episodes, `folder`/part_i_of_n.

    A shard that exists and was built from the same episodes with the same options is kept, so that an interrupted
    export continues.

    Args:
        episode_folders: Folders of all episodes.
        folder: Folder of all shards; their requests are in `SHARDS_FOLDER` below it.
        kind: One of `FORMATS`.
        shard: See `selection.choose_shard`.
        progress: Called with the progress.
        options: See `export_dataset`.

    Returns:
        The episodes of the shard, or None if its dataset was kept.

    Raises:
        AomgenError: See `export_dataset` and `selection.choose_shard`.
    """
    chosen, name = choose_shard(episode_folders, shard), shard_name(shard)
    if folder.is_file():
        raise ConfigError(folder, "is a file", "choose another folder")
    contents = {path.name: read_content(path) for path in chosen}
    request = {"version": __version__, "format": kind, "options": options, "episodes": contents}
    stated = folder / SHARDS_FOLDER / f"{name}.json"
    kept = (folder / name / MARK).is_file()
    if kept and reuse(stated, partial(read_json, stated, MAX_LIST_BYTES)) == request:
        return None
    earlier = stated.read_bytes() if stated.is_file() else None
    # If the process dies between the replacement of the dataset and the new request, the old one must not remain.
    stated.unlink(missing_ok=True)
    try:
        made = export_dataset(chosen, folder / name, kind, progress, **options)
    except AomgenError:
        # An export that fails keeps the dataset.
        if earlier is not None:
            write_bytes(stated, earlier)
        raise
    write_json(stated, request)
    return made


def find_format(folder: Path) -> DatasetFormat:
    """Recognize the format of a dataset.

    Raises:
        MissingFileError: The folder does not exist.
        MalformedFileError: The folder has no known format.
    """
    if not folder.is_dir():
        raise MissingFileError(folder, "is missing", "give the folder of a dataset")
    for known in FORMATS.values():
        if (folder / known.mark).is_file():
            return known
    marks = ", ".join(dict.fromkeys(known.mark for known in FORMATS.values()))
    raise MalformedFileError(
        folder, f"is not a dataset: it contains none of {marks}", "give the folder of a dataset"
    )


def _format(kind: str) -> DatasetFormat:
    if kind not in FORMATS:
        raise UnknownNameError("--format", kind, FORMATS)
    return FORMATS[kind]
