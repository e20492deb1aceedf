"""Export of a motion as a Rerun recording: Gaussians by body, poses, joints, cameras with videos, contacts."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from aomgen.conventions import xyzw_from_wxyz
from aomgen.core.camera import Camera
from aomgen.core.episode import FINGERS
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.errors import StorageError
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.atomic import scratch_folder, write_bytes
from aomgen.io.video import encode_video

APPLICATION: Final = "aomgen"
# Name of the time axis, which starts with the motion, [s].
TIMELINE: Final = "time"
# Length of the arrows of contact forces, [m/N].
FORCE_SCALE: Final = 0.005
# Degree of the stored spherical harmonics; lower degrees are padded.
DEGREE: Final = 3
# Distance of the displayed image plane from the camera, [m].
IMAGE_PLANE_M: Final = 0.2


def write_rerun(motion: SceneMotion, path: Path) -> None:
    """Write a motion as .rrd for `rerun FILE`; requires the package `rerun-sdk`.

    Entities: `world/<body>` with its Gaussians, `world/camera/<name>` with its video, `world/contacts/<finger>`,
    `joints/<name>`, `joints/gripper` and `joints/object`. Colors are those of the first frame.

    Raises:
        StorageError: Writing to the disk failed.
    """
    # Otherwise the package only prints errors and skips the affected data.
    rr.set_strict_mode(True)
    # The identifier depends only on the motion, so that a viewer replaces an earlier export.
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{path.stem}-{motion.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(path.parent) as folder:
            recording.save(folder / path.name)
            recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            _log_bodies(recording, motion)
            _log_cameras(recording, motion)
            _log_joints(recording, motion)
            _log_contacts(recording, motion)
            recording.flush()
            recording.disconnect()
            write_bytes(path, (folder / path.name).read_bytes())
    except OSError as error:
        raise StorageError(
            path, f"cannot be written ({error.strerror})", "free space or choose another folder"
        ) from error


def _log_bodies(recording: Any, motion: SceneMotion) -> None:
    for name, gaussians in motion.body_gaussians().items():
        recording.log(f"world/{name}", _splats(gaussians), static=True)
        number = motion.twin.body(name)
        Ts = motion.Ts_world_body[:, number]
        if number and not np.array_equal(Ts[0], Ts[-1]):
            _send_poses(recording, f"world/{name}", Ts, motion.trajectory.times_s)
        else:
            recording.log(f"world/{name}", _transform(Ts[0]), static=True)


def _splats(gaussians: Gaussians) -> Any:
    rgba = np.column_stack([gaussians.colors_srgb, gaussians.opacities])
    return rr.GaussianSplats3D(
        centers=gaussians.means,
        scales=gaussians.scales,
        quaternions=xyzw_from_wxyz(gaussians.quats.astype(np.float64)),
        colors=np.clip(np.rint(rgba * 255), 0, 255).astype(np.uint8),
        sh_coefficients=gaussians.with_sh_degree(DEGREE).sh[:, 1:],
        spherical_harmonics_degree=gaussians.sh_degree,
    )


def _transform(T: Array) -> Any:
    return rr.Transform3D(
        translation=T[:3, 3], quaternion=rr.Quaternion(xyzw=xyzw_from_wxyz(quat_from_matrix(T[:3, :3])))
    )


def _send_poses(recording: Any, entity: str, Ts: Array, times_s: Array) -> None:
    recording.send_columns(
        entity,
        [_time_column(times_s)],
        rr.Transform3D.columns(
            translation=Ts[:, :3, 3], quaternion=xyzw_from_wxyz(quat_from_matrix(Ts[:, :3, :3]))
        ),
    )


def _time_column(times_s: Array) -> Any:
    stamps = np.round(np.asarray(times_s, np.float64) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn(TIMELINE, duration=stamps)


def _log_cameras(recording: Any, motion: SceneMotion) -> None:
    moving: Mapping[str, Camera] = {name: item.at(0) for name, item in motion.paths.items()}
    for name, camera in {**motion.cameras, **moving}.items():
        entity = f"world/camera/{name}"
        if name in moving:
            _send_poses(recording, entity, motion.paths[name].Ts_world_cam, motion.trajectory.times_s)
        else:
            recording.log(entity, _transform(camera.T_world_cam), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=IMAGE_PLANE_M,
        )
        recording.log(entity, pinhole, static=True)
        if name in motion.videos:
            _log_video(recording, f"{entity}/video", motion, name)


def _log_video(recording: Any, entity: str, motion: SceneMotion, name: str) -> None:
    """Log a video, and a reference to each of its frames; only a video with lens distortion is encoded again."""
    video, times_s = rr.AssetVideo(path=motion.videos[name]), None
    if name in motion.lenses:
        video, times_s = _undistort_video(motion, name)
    recording.log(entity, video, static=True)
    stamps_ns = np.asarray(video.read_frame_timestamps_nanos())
    times_s = stamps_ns * 1e-9 if times_s is None else times_s
    recording.send_columns(
        entity,
        [_time_column(np.asarray(times_s + motion.video_starts_s[name], np.float64))],
        rr.VideoFrameReference.columns_nanos(stamps_ns),
    )


def _undistort_video(motion: SceneMotion, name: str) -> tuple[Any, Array]:
    """Encode the undistorted frames of a video at a constant rate; return it and the original times (F,), [s]."""
    times_s = list[float]()

    def images() -> Iterator[NDArray[np.uint8]]:
        for time_s, image in motion.decode_video(name):
            times_s.append(time_s)
            yield image

    content = encode_video(images(), max(round(motion.fps), 1))
    return rr.AssetVideo(contents=content, media_type="video/mp4"), np.array(times_s)


def _log_joints(recording: Any, motion: SceneMotion) -> None:
    moved, times = motion.trajectory, [_time_column(motion.trajectory.times_s)]
    series = dict(zip(motion.robot.joint_names, moved.joints.T, strict=True))
    for name, values in {**series, "gripper": moved.gripper, "object": moved.thetas}.items():
        recording.send_columns(f"joints/{name}", times, rr.Scalars.columns(scalars=values))


def _log_contacts(recording: Any, motion: SceneMotion) -> None:
    """Log contact forces on the fingers as arrows; frames without contact clear them."""
    contacts = motion.contacts
    if contacts is None:
        return
    for number, finger in enumerate(FINGERS):
        entity, shown = f"world/contacts/{finger}", False
        for frame, time_s in enumerate(motion.trajectory.times_s):
            rows = (contacts.frames == frame) & (contacts.fingers == number)
            recording.set_time(TIMELINE, duration=float(time_s))
            if rows.any():
                forces = contacts.normals_world[rows] * contacts.forces[rows, None]
                arrows = rr.Arrows3D(origins=contacts.points_world[rows], vectors=FORCE_SCALE * forces)
                recording.log(entity, arrows)
            elif shown:
                recording.log(entity, rr.Clear(recursive=False))
            shown = bool(rows.any())
        recording.reset_time()
