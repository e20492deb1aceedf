"""Columns and images of a dataset, computed from an episode.

LeRobot uses every `observation.*` as an input of a policy and every `action*` as its output. Therefore only
quantities that a robot measures are observations, only one action space is `action`, and all other features are
`annotation.*`.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.episode import Episode
from aomgen.core.keypoints import KEYPOINTS, move_keypoints, project_keypoints
from aomgen.core.transforms import (
    invert,
    matrix_from_rotvec,
    quat_from_matrix,
    rotvec_from_matrix,
    transform,
)
from aomgen.core.values import Array
from aomgen.errors import ConfigError, CorruptArtifactError
from aomgen.io.atomic import write_bytes
from aomgen.io.episode_folder import SAMPLED_FRAMES, CommittedEpisode, color_counts
from aomgen.io.images import resize
from aomgen.io.video import decode_frames, encode_video

# Spaces of actions; all describe the same targets.
ActionSpace = Literal["joint", "ee_absolute", "ee_delta"]
ACTION_SPACES: Final[tuple[ActionSpace, ...]] = get_args(ActionSpace)
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_DELTA = ("dx", "dy", "dz", "drx", "dry", "drz")
_IMAGE_POINT = ("u", "v", "visible")
OBJECT_POSE, WORLD_POINTS = "annotation.object_pose", "annotation.keypoints"
# Feature that LeRobot's policies observe instead of images, by the option --media; and its name in such datasets.
TOLD_FEATURES: Final = {"none": OBJECT_POSE, "keypoints": WORLD_POINTS}
TOLD: Final = "observation.environment_state"
# Quantiles that LeRobot v3.0 stores for each feature.
QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
# Quality of videos that are encoded again; it is higher than for rendered videos, because small images have more detail
# per pixel.
RESIZED_CRF = {"h264": 14, "av1": 15}


def action_feature(space: str, chosen: str) -> str:
    """Return the name of the feature with the actions of a space, in a dataset whose `action` is the chosen space."""
    return "action" if space == chosen else f"annotation.action.{space}"


def feature_names(episode: Episode, actions: ActionSpace = "joint") -> dict[str, tuple[str, ...]]:
    """Return the element names of every low-dimensional feature."""
    state = (*episode.joint_names, "gripper")
    spaces = {"joint": state, "ee_absolute": (*_POSE, "gripper"), "ee_delta": (*_DELTA, "gripper")}
    return {
        "observation.state": state,
        **{action_feature(space, actions): names for space, names in spaces.items()},
        "annotation.ee_pose": _POSE,
        OBJECT_POSE: _POSE,
        "annotation.object_joint": ("theta",),
        "annotation.finger_force": ("left", "right"),
        WORLD_POINTS: tuple(f"{point}_{axis}" for point in KEYPOINTS for axis in "xyz"),
        **{
            image_points_feature(name): tuple(
                f"{point}_{part}" for point in KEYPOINTS for part in _IMAGE_POINT
            )
            for name in sorted(episode.cameras)
        },
    }


def feature_columns(episode: Episode, actions: ActionSpace = "joint") -> dict[str, Array]:
    """Compute the values (T, D) of every low-dimensional feature; meters, radians, newtons, pixels.

    The three action spaces describe the same target, which is to be reached at the next frame (the target of the last
    frame is the pose to hold): `joint` by joint values, `ee_absolute` by the end effector's pose in the world frame,
    `ee_delta` by the motion from the previous target (`ee_deltas`, `last_targets`), so that deltas add up to the path
    even if the arm lags behind. The chosen space is `action`, the others are `annotation.action.<space>`. The last
    element of each is the gripper's target, 0 open .. 1 closed.
    """
    target = episode.action_gripper[:, None]
    deltas = ee_deltas(last_targets(episode), episode.Ts_world_ee_action)
    points = move_keypoints(episode.keypoints, episode.joint, episode.thetas)
    spaces = {
        "joint": np.column_stack([episode.action_joints, target]),
        "ee_absolute": np.column_stack([pose_vectors(episode.Ts_world_ee_action), target]),
        "ee_delta": np.column_stack([deltas, target]),
    }
    return {
        "observation.state": np.column_stack([episode.joints, episode.gripper]),
        **{action_feature(space, actions): values for space, values in spaces.items()},
        "annotation.ee_pose": pose_vectors(episode.Ts_world_ee),
        OBJECT_POSE: np.tile(pose_vectors(episode.T_world_object[None]), (len(episode), 1)),
        "annotation.object_joint": episode.thetas[:, None],
        "annotation.finger_force": finger_forces(episode),
        WORLD_POINTS: points.reshape(len(episode), -1),
        **{
            image_points_feature(name): _image_points(episode, name, points)
            for name in sorted(episode.cameras)
        },
    }


def image_points_feature(camera: str) -> str:
    """Return the name of the feature with the keypoints in a camera's images."""
    return f"annotation.keypoints_px.{camera}"


def _image_points(episode: Episode, camera: str, points_world: Array) -> Array:
    """Project keypoints (T, 5, 3) to x, y [px] and visibility (1 or 0), as (T, 15)."""
    pixels = [
        project_keypoints(episode.camera_at(camera, t), points)[0] for t, points in enumerate(points_world)
    ]
    visible = np.asarray(episode.visible[camera], np.float64)[..., None]
    return np.concatenate([np.reshape(pixels, (*visible.shape[:2], 2)), visible], -1).reshape(
        len(episode), -1
    )


def last_targets(episode: Episode) -> Array:
    """Return the previous target (T, 4, 4) of the end effector for each action; the first one is its observed pose."""
    return np.concatenate([episode.Ts_world_ee[:1], episode.Ts_world_ee_action[:-1]])


def ee_deltas(Ts_world_last: Array, Ts_world_target: Array) -> Array:
    """Compute the motion from poses (T, 4, 4) to targets (T, 4, 4) as vectors (T, 6).

    Both parts are in the axes of the first pose: translation x, y, z, [m], then rotation vector, [rad]. The inverse is
    `ee_targets`.
    """
    Ts_last_target = invert(Ts_world_last) @ Ts_world_target
    return np.column_stack([Ts_last_target[:, :3, 3], rotvec_from_matrix(Ts_last_target[:, :3, :3])])


def ee_targets(Ts_world_last: Array, deltas: Array) -> Array:
    """Compute targets (T, 4, 4) from poses (T, 4, 4) and deltas (T, 6); the inverse of `ee_deltas`."""
    return Ts_world_last @ transform(matrix_from_rotvec(deltas[:, 3:6]), deltas[:, :3])


def pose_vectors(Ts: Array) -> Array:
    """Convert poses to positions and quaternions wxyz (T, 7) with continuous signs."""
    quats = quat_from_matrix(Ts[:, :3, :3])
    if len(quats) and quats[0, 0] < 0:
        quats[0] *= -1
    flips = np.sign(np.einsum("td,td->t", quats[1:], quats[:-1]))
    quats[1:] *= np.cumprod(np.where(flips == 0, 1, flips))[:, None]
    return np.column_stack([Ts[:, :3, 3], quats])


def finger_forces(episode: Episode) -> Array:
    """Compute the sum of the normal forces of each of `FINGERS` on the object at every frame (T, 2), [N]."""
    forces = np.zeros((len(episode), 2))
    contacts = episode.contacts
    np.add.at(forces, (contacts.frames, contacts.fingers), contacts.forces)
    return forces


def column_statistics(values: ArrayLike) -> dict[str, list]:
    """Compute min, max, mean, std, count and quantiles of each column of (T, D)."""
    data = np.asarray(values, np.float64)
    result = {"min": data.min(0), "max": data.max(0), "mean": data.mean(0), "std": data.std(0)}
    result |= {name: np.quantile(data, share, axis=0) for name, share in QUANTILES.items()}
    return {name: array.tolist() for name, array in result.items()} | {"count": [len(data)]}


def image_statistics(counts: NDArray[np.int64], frames: int) -> dict[str, list]:
    """Compute statistics (3, 1, 1) of the color channels, 0..1, from counts (3, 256) of a number of frames."""
    levels = np.arange(256) / 255
    shares = counts / counts.sum(1, keepdims=True)
    mean = shares @ levels
    std = np.sqrt(np.maximum(shares @ levels**2 - mean**2, 0))
    cumulated = np.cumsum(shares, 1)

    def level(share: float) -> Array:
        return np.array([levels[min(int(np.searchsorted(row, share)), 255)] for row in cumulated])

    present = counts > 0
    result = {"min": levels[present.argmax(1)], "max": levels[255 - present[:, ::-1].argmax(1)]}
    result |= {"mean": mean, "std": std} | {name: level(share) for name, share in QUANTILES.items()}
    return {name: array.reshape(3, 1, 1).tolist() for name, array in result.items()} | {"count": [frames]}


def read_images(item: CommittedEpisode, camera: str) -> Iterator[NDArray[np.uint8]]:
    """Yield frames (H, W, 3) of one camera at its size, reduced by area averaging if the video is larger.

    Raises:
        CorruptArtifactError: The video has another length than the episode.
        MissingFileError, MalformedFileError: See `io.video.decode_frames`.
    """
    view, count = item.episode.cameras[camera], 0
    for _, frame in decode_frames(item.videos[camera]):
        image = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
        same = image.shape[:2] == (view.height, view.width)
        yield image if same else resize(image, view.width, view.height)
        count += 1
    check_length(item, camera, count)


def check_length(item: CommittedEpisode, camera: str, frames: int) -> None:
    """Refuse a video that does not show every frame of its episode.

    Raises:
        CorruptArtifactError: The video has another length.
    """
    if frames != len(item.episode):
        raise CorruptArtifactError(
            item.videos[camera], f"has {frames} frames, the episode {len(item.episode)}", "generate it again"
        )


def count_colors(images: list[NDArray[np.uint8]]) -> NDArray[np.int64]:
    """Compute the histogram (3, 256) of the values 0..255 in each channel of some images of an episode."""
    return color_counts(np.stack(images[:: max(len(images) // SAMPLED_FRAMES, 1)]))


def resize_videos(item: CommittedEpisode, folder: Path) -> CommittedEpisode:
    """Resize the videos of an episode to the size of its cameras, with new color counts; new files are in `folder`.

    Raises:
        ConfigError: A side of the images is odd; videos store colors for two by two pixels.
    """
    videos, counts = dict(item.videos), dict(item.color_counts)
    for name, camera in item.episode.cameras.items():
        if camera.width % 2 or camera.height % 2:
            raise ConfigError("--size", f"{camera.width}x{camera.height} is odd", "videos need even sides")
        images = list(read_images(item, name))
        videos[name] = folder / f"{item.folder.name}.{name}.mp4"
        counts[name] = count_colors(images)
        data = encode_video(images, item.episode.fps, codec=item.codec, crf=RESIZED_CRF[item.codec])
        write_bytes(videos[name], data)
    return replace(item, videos=videos, color_counts=counts)
