"""Episodes on disk: one folder each, complete or absent.

```
episodes/000007/
  episode.json     names, seeds, cameras, joint, contacts, verdict, sha256 of the other files
  frames.npz       per-frame arrays
  <camera>.mp4     one video for each camera
```
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.episode import ContactLog, Episode
from aomgen.core.joint import Joint
from aomgen.errors import CorruptArtifactError, MalformedFileError
from aomgen.io.artifact import arrays_from_bytes, npz_bytes, read_json
from aomgen.io.atomic import STAGING_PREFIX, staged_folder, write_bytes, write_json

# Raised when the files of an episode change.
FORMAT: Final = 2
EPISODE_FILE: Final = "episode.json"
# Largest frames.npz read, [bytes]: far above a usual one.
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
_CONTACT_ARRAYS: Final = ("frames", "fingers", "points_world", "normals_world", "forces")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommittedEpisode:
    """An episode that is safely on disk.

    Attributes:
        folder: Where it lies.
        episode: Its content.
        videos: MP4 path of each camera.
        sha256: Digest of each file beside episode.json.
    """

    folder: Path
    episode: Episode
    videos: Mapping[str, Path]
    sha256: Mapping[str, str]


def episode_folder(root: Path, index: int) -> Path:
    """Folder of one episode below the folder of all episodes."""
    return root / f"{index:06d}"


def commit_episode(root: Path, episode: Episode, videos: Mapping[str, bytes]) -> Path:
    """Write an episode so that it appears complete or not at all.

    Args:
        root: Folder of all episodes.
        episode: What to store.
        videos: MP4 bytes by camera name; the same names as `episode.cameras`.

    Returns:
        The episode's folder.

    Raises:
        StorageError: The disk refuses.
        ValueError: Videos and cameras differ in their names; a programming error.
    """
    if set(videos) != set(episode.cameras):
        raise ValueError(f"videos {sorted(videos)} do not match cameras {sorted(episode.cameras)}")
    files = {"frames.npz": npz_bytes(_frame_arrays(episode))} | {
        f"{name}.mp4": videos[name] for name in sorted(videos)
    }
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    path = episode_folder(root, episode.index)
    with staged_folder(path) as folder:
        for name, data in files.items():
            write_bytes(folder / name, data)
        write_json(folder / EPISODE_FILE, {**_header(episode), "sha256": digests})
    return path


def list_committed(root: Path) -> list[Path]:
    """Folders of complete episodes in index order; half-written ones do not count."""
    if not root.is_dir():
        return []
    folders = [p for p in root.iterdir() if p.is_dir() and not p.name.startswith(STAGING_PREFIX)]
    return sorted(p for p in folders if p.name.isdigit() and (p / EPISODE_FILE).is_file())


def read_episode(folder: Path) -> CommittedEpisode:
    """Read an episode and check every file against its digest.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: episode.json cannot be read.
        CorruptArtifactError: A file is missing or does not match its digest.
    """
    where = folder / EPISODE_FILE
    header = read_json(where)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MalformedFileError(where, f"is not an episode of format {FORMAT}", "generate the episode again")
    try:
        digests: dict[str, str] = dict(header["sha256"])
        expected = {"frames.npz", *(f"{name}.mp4" for name in header["cameras"])}
        if set(digests) != expected:
            raise MalformedFileError(where, f"names files {sorted(digests)}, want {sorted(expected)}")
        data = {name: _checked(folder / name, digest) for name, digest in sorted(digests.items())}
        episode = _episode(header, arrays_from_bytes(data["frames.npz"], folder / "frames.npz"))
        videos = {name: folder / f"{name}.mp4" for name in episode.cameras}
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedFileError(
            where, f"is not complete ({error!r})", "generate the episode again"
        ) from error
    return CommittedEpisode(folder=folder, episode=episode, videos=videos, sha256=digests)


def _checked(path: Path, digest: str) -> bytes:
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
    return {name: getattr(episode, name) for name in _ARRAYS} | contacts


def _header(episode: Episode) -> dict[str, Any]:
    joint = episode.joint
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
        "joint": {
            "type": joint.type,
            "axis": joint.axis,
            "origin": joint.origin,
            "lower": joint.lower,
            "upper": joint.upper,
        },
        "T_world_object": episode.T_world_object,
        "cameras": {name: camera_dict(camera) for name, camera in episode.cameras.items()},
        "verdict": dict(episode.verdict),
        "simulation": dict(episode.simulation),
    }


def camera_dict(camera: Camera) -> dict[str, Any]:
    """Plain JSON values of a camera."""
    names = ("fx", "fy", "cx", "cy", "width", "height", "T_world_cam")
    return {name: getattr(camera, name) for name in names}


def _episode(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Episode:
    names = ("index", "seed", "instruction", "robot", "asset", "asset_usd", "fps", "T_world_object")
    names += ("verdict", "simulation")
    plain: dict[str, Any] = {name: header[name] for name in names} | {name: arrays[name] for name in _ARRAYS}
    contacts: dict[str, Any] = {name: arrays[f"contact_{name}"] for name in _CONTACT_ARRAYS}
    return Episode(
        **plain,
        joint_names=tuple(header["joint_names"]),
        contacts=ContactLog(**contacts),
        joint=Joint(**header["joint"]),
        cameras={name: Camera(**values) for name, values in header["cameras"].items()},
    )
