"""Reading robomimic datasets of our own back."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.datasets.features import ACTION_SPACES
from aomgen.datasets.robomimic import FILE, MASKS, unscale_actions
from aomgen.datasets.stored import REMEDY, StoredDataset, StoredEpisode
from aomgen.errors import MalformedFileError, MissingFileError, suggest

IMAGE: Final = "_image"


def read_robomimic(folder: Path) -> StoredDataset:
    """Open a dataset.

    Raises:
        MissingFileError: The file is missing.
        MalformedFileError: It is damaged, cut or lacks a feature.
    """
    import h5py

    where = folder / FILE
    if not where.is_file():
        raise MissingFileError(where, "is missing", REMEDY)
    try:
        file: Any = h5py.File(where, "r")
        actions = str(file["data"].attrs["action_space"])
        first = file["data/demo_0/obs"]
        cameras = [name.removesuffix(IMAGE) for name in first if name.endswith(IMAGE)]
        shapes = {name: first[name + IMAGE].shape for name in cameras}
    except (KeyError, OSError, RuntimeError) as error:
        raise _make_damage_error(where, error) from error
    if actions not in ACTION_SPACES:
        raise MalformedFileError(where, f"says action_space '{actions}'", suggest(actions, ACTION_SPACES))
    return StoredDataset(
        actions=actions,  # type: ignore[arg-type]
        sizes={name: (int(shape[2]), int(shape[1])) for name, shape in shapes.items()},
        episodes=_episodes(file, where, cameras),
    )


def _make_damage_error(where: Path, error: Exception) -> MalformedFileError:
    return MalformedFileError(where, f"is damaged or lacks a feature ({error})", REMEDY)


def _episodes(file: Any, where: Path, cameras: list[str]) -> Iterator[StoredEpisode]:
    with file:
        try:
            limits = (file["data"].attrs["action_lower"], file["data"].attrs["action_upper"])
            for split, mask in MASKS.items():
                for name in file[f"mask/{mask}"][:]:
                    yield _episode(file["data"][name.decode()], split, limits, cameras)
        except (KeyError, OSError, RuntimeError) as error:
            raise _make_damage_error(where, error) from error


def _episode(group: Any, split: str, limits: tuple[Any, Any], cameras: list[str]) -> StoredEpisode:
    columns: dict[str, NDArray[Any]] = {
        "observation.state": group["obs/state"][:],
        "action": unscale_actions(group["actions"][:], *limits),
    }
    for name in ("ee_pose", "object_pose", "object_joint", "finger_force"):
        columns[f"annotation.{name}"] = group[f"annotation/{name}"][:]
    for space in group["annotation/action"]:
        columns[f"annotation.action.{space}"] = group[f"annotation/action/{space}"][:]
    return StoredEpisode(
        source_index=int(group.attrs["source_index"]),
        split=split,
        instruction=str(group.attrs["instruction"]),
        columns=columns,
        pictures={camera: iter(np.asarray(group[f"obs/{camera}{IMAGE}"])) for camera in cameras},
    )
