"""Reader and writer of HDF5 datasets in robomimic's layout: one file, one group per demonstration, masks for splits.

The last layer of robomimic's policies is a tanh. Therefore `actions` are scaled to [-1, 1] over the whole dataset; the
limits are attributes of the data. Annotations contain the unscaled actions of every space.

Source: robomimic's documentation "Dataset contents and info".
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.progress import Progress, silent
from aomgen.core.values import Array
from aomgen.datasets.features import ACTION_SPACES, feature_columns, image_points_feature, read_images
from aomgen.datasets.selection import (
    REMEDY,
    Choices,
    Selection,
    StoredDataset,
    StoredEpisode,
    select_episodes,
    stage_dataset,
)
from aomgen.errors import ConfigError, MalformedFileError, MissingFileError, suggest
from aomgen.io.episode_folder import CommittedEpisode

FILE: Final = "demonstrations.hdf5"
# Type number of Gym environments in robomimic.
GYM_TYPE: Final = 2
# Names of the splits in robomimic.
MASKS: Final = {"train": "train", "val": "valid"}
IMAGE: Final = "_image"


def write_robomimic(
    episode_folders: Sequence[Path], folder: Path, choices: Choices, progress: Progress = silent
) -> Selection:
    """Build a dataset from committed episodes; arguments, result and errors as `lerobot_v3.write_lerobot_v3`.

    Raises:
        ConfigError: The validation split would be empty.
    """
    import h5py

    if not choices.val:
        raise ConfigError("--val", "is 0", "robomimic requires a mask of validation demonstrations")
    selection = select_episodes(episode_folders, folder, choices)
    limits = action_limits(selection)
    with stage_dataset(folder, selection) as staging, h5py.File(staging / FILE, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = selection.frames
        data.attrs["env_args"] = json.dumps(
            {"env_name": "aomgen/Open-v0", "type": GYM_TYPE, "env_kwargs": {}}
        )
        data.attrs["action_space"] = choices.actions
        data.attrs["action_lower"], data.attrs["action_upper"] = limits
        for number, item in enumerate(selection.episodes):
            _write_demonstration(data.create_group(f"demo_{number}"), item, selection, limits)
            progress((number + 1) / len(selection.episodes), f"{number + 1} of {len(selection.episodes)}")
        numbers = iter(range(len(selection.episodes)))
        for split, episodes in selection.splits.items():
            names = [f"demo_{next(numbers)}" for _ in episodes]
            file.create_dataset(f"mask/{MASKS[split]}", data=np.array(names, "S"))
    return selection


def action_limits(selection: Selection) -> tuple[Array, Array]:
    """Compute the smallest and the largest value (D,) of each element of the actions."""
    actions = np.concatenate(
        [feature_columns(item.episode, selection.choices.actions)["action"] for item in selection.episodes]
    )
    return actions.min(0), actions.max(0)


def scale_actions(actions: Array, lower: Array, upper: Array) -> Array:
    """Scale actions (T, D) from lower..upper to -1..1; a constant element becomes 0."""
    span = upper - lower
    return np.where(span > 0, 2 * (actions - lower) / np.where(span > 0, span, 1) - 1, 0)


def unscale_actions(scaled: Array, lower: Array, upper: Array) -> Array:
    """Invert `scale_actions`."""
    return lower + (scaled + 1) / 2 * (upper - lower)


def _write_demonstration(
    group: Any, item: CommittedEpisode, selection: Selection, limits: tuple[Array, Array]
) -> None:
    episode = item.episode
    columns = feature_columns(episode, selection.choices.actions)
    last = np.arange(len(episode)) == len(episode) - 1
    group.attrs["num_samples"] = len(episode)
    group.attrs["instruction"] = episode.instruction
    group.attrs["source_index"] = episode.index
    group.attrs["asset"] = episode.asset
    group["actions"] = scale_actions(columns["action"], *limits)
    group["states"] = np.column_stack([episode.joints, episode.gripper, episode.thetas])
    group["rewards"] = last.astype(np.float64)
    group["dones"] = last.astype(np.int64)
    for name, values in columns.items():
        if name.startswith("annotation"):
            group[name.replace(".", "/")] = values
    group[f"annotation/action/{selection.choices.actions}"] = columns["action"]
    group["obs/state"] = columns["observation.state"]
    for camera in sorted(episode.cameras):
        images = np.stack(list(read_images(item, camera)))
        # One frame per chunk, because readers load single frames.
        group.create_dataset(
            f"obs/{camera}_image",
            data=images,
            chunks=(1, *images.shape[1:]),
            compression="gzip",
            compression_opts=1,
        )
    for name in list(group["obs"]):
        _add_next(group, name)


def _add_next(group: Any, name: str) -> None:
    """Add the next observation of each step (the last one is repeated) as a virtual dataset, which needs no storage."""
    from h5py import h5d, h5p, h5s

    source = group["obs"][name]
    count, *rest = source.shape

    def frames(start: int, number: int) -> h5s.SpaceID:
        chosen = h5s.create_simple(source.shape)
        chosen.select_hyperslab((start, *[0] * len(rest)), (number, *rest))
        return chosen

    # h5py's VirtualLayout is not used, because it stores the time of creation.
    properties = h5p.create(h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    here, path = b".", source.name.encode()
    properties.set_virtual(frames(0, count - 1), here, path, frames(1, count - 1))
    properties.set_virtual(frames(count - 1, 1), here, path, frames(count - 1, 1))
    target = group.require_group("next_obs").id
    h5d.create(target, name.encode(), source.id.get_type(), h5s.create_simple(source.shape), dcpl=properties)


def read_robomimic(folder: Path) -> StoredDataset:
    """Open a dataset.

    Raises:
        MissingFileError: The file is missing.
        MalformedFileError: The file is damaged or truncated, or lacks a feature.
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
        raise MalformedFileError(where, f"states action_space '{actions}'", suggest(actions, ACTION_SPACES))
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
    for name in ("ee_pose", "object_pose", "object_joint", "finger_force", "keypoints"):
        columns[f"annotation.{name}"] = group[f"annotation/{name}"][:]
    for space in group["annotation/action"]:
        columns[f"annotation.action.{space}"] = group[f"annotation/action/{space}"][:]
    for camera in cameras:
        columns[image_points_feature(camera)] = group[image_points_feature(camera).replace(".", "/")][:]
    return StoredEpisode(
        source_index=int(group.attrs["source_index"]),
        split=split,
        instruction=str(group.attrs["instruction"]),
        columns=columns,
        images={camera: iter(np.asarray(group[f"obs/{camera}{IMAGE}"])) for camera in cameras},
    )
