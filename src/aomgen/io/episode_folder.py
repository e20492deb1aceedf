"""Storage of episodes: each is one folder, which is either complete or absent.

```
episodes/000007/
  episode.json          names, seeds, cameras, joint, contacts, verdict, sha256 of the other files
  frames.npz            per-frame arrays, color statistics of the videos
  <camera>.mp4          one video for each camera
  <camera>.depth.npz    optional: depth (T, H, W) uint16, [mm], 0 where there is no surface
  <camera>.labels.npz   optional: part labels (T, H, W) uint8, see `conventions.PART_LABELS`
```
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.joint import Joint
from aomgen.core.plan import Variation
from aomgen.errors import CorruptArtifactError, MalformedFileError
from aomgen.io.artifact import arrays_from_bytes, npz_bytes, read_json, read_npz, restore
from aomgen.io.atomic import stage_folder, write_bytes, write_json
from aomgen.io.video import Codec, decode_samples

# Version of the layout of an episode's files.
FORMAT: Final = 4
EPISODE_FILE: Final = "episode.json"
# Number of frames per video in the color statistics, approximately; every fourth row and column of them is counted.
SAMPLED_FRAMES: Final = 20
# Largest file of an episode that is read, [bytes]; common ones are far smaller.
MAX_FRAMES_BYTES: Final = 256 << 20
_ARRAYS: Final = (
    "joints",
    "gripper",
    "action_joints",
    "action_gripper",
    "Ts_world_ee",
    "Ts_world_ee_action",
    "thetas",
    "phases",
)
# Kinds of images that are stored without loss: depth, [mm], and part labels.
ImageKind = Literal["depth", "labels"]
_IMAGE_TYPES: Final = {"depth": np.uint16, "labels": np.uint8}
_CONTACT_ARRAYS: Final = ("frames", "fingers", "points_world", "normals_world", "forces")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommittedEpisode:
    """An episode that is stored completely on disk.

    Attributes:
        folder: Folder of the episode.
        episode: Content of the episode.
        videos: Path of the MP4 file by camera name.
        sha256: SHA-256 digest of each file except episode.json, by file name.
        codec: Codec of the videos.
        color_counts: Histogram (3, 256) of the values 0..255 in each channel of sampled frames, by camera.
        images: Files of lossless images by kind and camera; see `read_images`.
    """

    folder: Path
    episode: Episode
    videos: Mapping[str, Path]
    sha256: Mapping[str, str]
    codec: Codec
    color_counts: Mapping[str, NDArray[np.int64]]
    images: Mapping[ImageKind, Mapping[str, Path]]


def read_variation(committed: CommittedEpisode) -> Variation:
    """Read the variation from the verdict of an episode.

    Raises:
        MalformedFileError: The verdict contains no valid variation.
    """
    try:
        return restore(Variation, committed.episode.verdict["variation"])
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(
            committed.folder, f"states no variation ({error})", "generate the episode again"
        ) from error


def episode_folder(root: Path, index: int) -> Path:
    """Return the folder of the episode with an index inside `root`, the folder of all episodes."""
    return root / f"{index:06d}"


def commit_episode(
    root: Path,
    episode: Episode,
    videos: Mapping[str, bytes],
    images: Mapping[ImageKind, Mapping[str, NDArray[np.integer]]] | None = None,
    codec: Codec = "h264",
) -> Path:
    """Write an episode so that it appears complete or not at all.

    Args:
        root: Folder of all episodes.
        episode: Episode to store.
        videos: MP4 bytes by camera name, for each of `episode.cameras`.
        images: Lossless images (T, H, W) by kind and camera.
        codec: Codec of the videos.

    Returns:
        Folder of the episode.

    Raises:
        StorageError: Writing to the disk failed.
        CorruptArtifactError: A video cannot be decoded, or its number of frames differs from that of the episode.
        ValueError: The camera names of videos, images or visible keypoints differ from those of the episode, or images have
            the wrong shape or data type. This is a programming error.
    """
    images, path = images or {}, episode_folder(root, episode.index)
    for kind, by_camera in {"videos": videos, "visible keypoints": episode.visible, **images}.items():
        if set(by_camera) != set(episode.cameras):
            raise ValueError(f"{kind} {sorted(by_camera)} do not match cameras {sorted(episode.cameras)}")
    arrays = _frame_arrays(episode)
    for name in sorted(videos):
        arrays[f"colors_{name}"] = _color_counts(videos[name], path / f"{name}.mp4", len(episode))
    files = {"frames.npz": npz_bytes(arrays)} | {f"{name}.mp4": videos[name] for name in sorted(videos)}
    for kind, by_camera in images.items():
        for name, stack in sorted(by_camera.items()):
            camera = episode.cameras[name]
            want = (len(episode), camera.height, camera.width)
            if stack.shape != want or stack.dtype != _IMAGE_TYPES[kind]:
                raise ValueError(
                    f"{kind} of {name} has shape {stack.shape} of {stack.dtype}, expected {want}"
                )
            files[_image_file(name, kind)] = npz_bytes({kind: stack}, packed=True)
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    header = {**_header(episode), "codec": codec, "images": sorted(images), "sha256": digests}
    with stage_folder(path) as folder:
        for name, data in files.items():
            write_bytes(folder / name, data)
        write_json(folder / EPISODE_FILE, header)
    return path


def color_counts(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Compute the histogram (3, 256) of the values 0..255 in each channel of frames (F, H, W, 3)."""
    return np.stack([np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)])


def _color_counts(video: bytes, path: Path, frames: int) -> NDArray[np.int64]:
    """Decode a video to its end, check its number of frames, and compute `color_counts` of sampled frames."""
    count, samples = decode_samples(video, path, max(frames // SAMPLED_FRAMES, 1))
    if count != frames:
        raise CorruptArtifactError(path, f"has {count} frames, the episode {frames}", "generate it again")
    return color_counts(np.stack(samples)[:, ::4, ::4])


def _image_file(camera: str, kind: str) -> str:
    return f"{camera}.{kind}.npz"


def read_images(path: Path) -> NDArray[np.integer]:
    """Read the lossless images (T, H, W) of one file of `CommittedEpisode.images`.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: The file is missing, malformed or too large.
    """
    arrays = read_npz(path)
    kind = path.name.split(".")[-2]
    if set(arrays) != {kind} or arrays[kind].ndim != 3 or arrays[kind].dtype != _IMAGE_TYPES.get(kind):
        raise MalformedFileError(path, f"holds no images of {kind}", "generate the episode again")
    return arrays[kind]


def list_committed(root: Path) -> list[Path]:
    """List the folders of complete episodes in `root`, in index order."""
    return [root / name for name in list_committed_names(root)]


def list_committed_names(root: Path) -> list[str]:
    """List the names of the folders of complete episodes in index order.

    A run may have 100,000 episodes; each of them takes one system call and no `Path`.
    """
    if not root.is_dir():
        return []
    with os.scandir(root) as entries:
        return sorted(
            entry.name
            for entry in entries
            if entry.name.isdigit() and os.path.isfile(f"{entry.path}/{EPISODE_FILE}")
        )


def read_episode(folder: Path) -> CommittedEpisode:
    """Read an episode and check every file against its digest.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: episode.json cannot be read.
        CorruptArtifactError: A file is missing, too large or does not match its digest.
    """
    where = folder / EPISODE_FILE
    header = read_json(where)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MalformedFileError(where, f"is not an episode of format {FORMAT}", "generate the episode again")
    try:
        digests: dict[str, str] = dict(header["sha256"])
        images = {
            kind: {name: folder / _image_file(name, kind) for name in header["cameras"]}
            for kind in header["images"]
        }
        expected = {"frames.npz", *(f"{name}.mp4" for name in header["cameras"])}
        expected |= {file.name for files in images.values() for file in files.values()}
        if set(digests) != expected:
            raise MalformedFileError(where, f"names files {sorted(digests)}, expected {sorted(expected)}")
        data = {name: _check(folder / name, digest) for name, digest in sorted(digests.items())}
        arrays = arrays_from_bytes(data["frames.npz"], folder / "frames.npz")
        episode = _episode(header, arrays)
        videos = {name: folder / f"{name}.mp4" for name in episode.cameras}
        counts = {name: arrays[f"colors_{name}"] for name in videos}
        codec = header["codec"]
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(
            where, f"is not complete ({error!r})", "generate the episode again"
        ) from error
    return CommittedEpisode(
        folder=folder,
        episode=episode,
        videos=videos,
        sha256=digests,
        codec=codec,
        color_counts=counts,
        images=images,
    )


def _check(path: Path, digest: str) -> bytes:
    if not path.is_file():
        raise CorruptArtifactError(path, "is missing", "delete the episode's folder and run again")
    if not path.stat().st_size <= MAX_FRAMES_BYTES:
        raise CorruptArtifactError(
            path, f"is larger than {MAX_FRAMES_BYTES} bytes", "delete it and run again"
        )
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != digest:
        raise CorruptArtifactError(
            path, "does not match its digest", "delete the episode's folder and run again"
        )
    return data


def _frame_arrays(episode: Episode) -> dict[str, NDArray[Any]]:
    contacts = {f"contact_{name}": getattr(episode.contacts, name) for name in _CONTACT_ARRAYS}
    poses = {f"Ts_world_cam_{name}": np.asarray(Ts) for name, Ts in sorted(episode.camera_poses.items())}
    visible = {f"visible_{name}": np.asarray(shown) for name, shown in sorted(episode.visible.items())}
    return {name: getattr(episode, name) for name in _ARRAYS} | contacts | poses | visible


def _header(episode: Episode) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "index": episode.index,
        "seed": episode.seed,
        "instruction": episode.instruction,
        "robot": episode.robot,
        "asset": episode.asset,
        "asset_usd": episode.asset_usd,
        "joint_names": list(episode.joint_names),
        "fps": episode.fps,
        "frames": len(episode),
        "joint": asdict(episode.joint),
        "T_world_object": episode.T_world_object,
        "keypoints": episode.keypoints,
        "cameras": {name: asdict(camera) for name, camera in episode.cameras.items()},
        "verdict": dict(episode.verdict),
        "simulation": dict(episode.simulation),
    }


def _episode(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Episode:
    names = ("index", "seed", "instruction", "robot", "asset", "asset_usd", "fps", "T_world_object")
    names += ("keypoints", "verdict", "simulation")
    plain: dict[str, Any] = {name: header[name] for name in names} | {name: arrays[name] for name in _ARRAYS}
    contacts: dict[str, Any] = {name: arrays[f"contact_{name}"] for name in _CONTACT_ARRAYS}
    return Episode(
        **plain,
        times_s=np.arange(len(plain["thetas"])) / header["fps"],
        joint_names=tuple(header["joint_names"]),
        contacts=ContactLog(**contacts),
        joint=Joint(**header["joint"]),
        cameras={name: Camera(**values) for name, values in header["cameras"].items()},
        camera_poses={
            name: arrays[key] for name in header["cameras"] if (key := f"Ts_world_cam_{name}") in arrays
        },
        visible={name: arrays[f"visible_{name}"] for name in header["cameras"]},
    )
