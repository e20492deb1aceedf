"""The content of a capture folder as checked values."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.lens import Lens
from aomgen.core.values import Array, Matrix4, freeze_arrays

# Standard deviation of a focal length from a data sheet, as a share: lenses differ by sample and focus.
STATED_FOCAL_SD = 0.02
# Standard deviation of a focal length that was calibrated with a target, as a share.
CALIBRATED_FOCAL_SD = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class JointLog:
    """Arm joints and gripper over the log's own clock.

    Attributes:
        times_s: (T,), strictly increasing, log clock.
        joints: (T, J), [rad], in the order of `joint_names`.
        gripper: (T,), 0 open .. 1 closed.
        joint_names: J names.
    """

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T N"]
    gripper: Annotated[Array, "T"]
    joint_names: Annotated[tuple[str, ...], "N"]

    __post_init__ = freeze_arrays

    def at(self, times_s: ArrayLike) -> tuple[Array, Array]:
        """Interpolate joints (N, J) and gripper (N,) linearly at log times (N,), ends held."""
        times = np.asarray(times_s, np.float64)
        columns = [np.interp(times, self.times_s, column) for column in self.joints.T]
        return np.stack(columns, -1), np.interp(times, self.times_s, self.gripper)

    def shift(self, offset_s: float) -> "JointLog":
        """Shift the log to a clock that is behind this one by an offset, [s]."""
        return replace(self, times_s=self.times_s - offset_s)

    def covers(self, times_s: ArrayLike) -> NDArray[np.bool_]:
        """Return a mask of the times inside the log."""
        times = np.asarray(times_s, np.float64)
        return (times >= self.times_s[0]) & (times <= self.times_s[-1])


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotChoice:
    """The robot model of the log, and its state during the scan.

    Attributes:
        model: A robot known by name, or "" when `model_file` is given.
        model_file: URDF or MJCF inside the capture, or None.
        root: Folder that holds everything the file refers to.
        references: All files that `model_file` refers to.
        base_frame: "base_link" or "ur_base", the frame of the log and of given camera poses.
        joints: Names (J) of the arm joints in the order of the log.
        scan_joints: Joint values (J,) during the scan, [rad] or [m].
        scan_gripper: Gripper during the scan, 0..1.
    """

    model: str
    model_file: Path | None
    root: Path
    references: tuple[Path, ...]
    base_frame: str
    joints: Annotated[tuple[str, ...], "J"]
    scan_joints: Annotated[Array, "J"]
    scan_gripper: float

    __post_init__ = freeze_arrays


def frame_name(index: int) -> str:
    """Name the image of a frame of a scan video; names sort in the order of time."""
    return f"scan_{index:06d}.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Stated intrinsics, [px], principal point with pixel centres at +0.5, used as a prior.

    Attributes:
        distortion: Stated k1, k2, p1, p2 (see `Lens`); None when unknown.
        calibrated: Measured with a target, not taken from a data sheet or another setting.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] | None = None
    calibrated: bool = False

    def lens(self, width: int, height: int) -> Lens:
        """Return the optics of images of a size, [px], without distortion where none is stated."""
        k1, k2, p1, p2 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        return Lens(
            fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=width, height=height, k1=k1, k2=k2, p1=p1, p2=p2
        )  # fmt: skip

    @property
    def focal_sd(self) -> float:
        """Standard deviation of the focal length, as a share of it."""
        return CALIBRATED_FOCAL_SD if self.calibrated else STATED_FOCAL_SD


@dataclass(frozen=True, slots=True, kw_only=True)
class Prompt:
    """A person's annotation of one part on one scan image.

    Attributes:
        part: "robot", "moving" or "static".
        image: File name of the scan image.
        points: (N, 3): x, y, [px], and label 1 = on the part, 0 = not on it.
        box: (4,) x0, y0, x1, y1, [px]; empty (0,) when none was given.
    """

    part: str
    image: str
    points: Annotated[Array, "_ 3"]
    box: Annotated[Array, "_"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoCamera:
    """One fixed camera of the demonstration.

    Attributes:
        name: For example "front".
        video: Path of its video.
        intrinsics: Known intrinsics, or None to estimate them.
        T_world_cam: Known hand-eye calibration (4, 4), or None.
        lens: Distortion of the video's frames, which are undistorted when they are read; None without any.
    """

    name: str
    video: Path
    intrinsics: Intrinsics | None
    T_world_cam: Matrix4 | None
    lens: Lens | None = None

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanPoses:
    """Poses of scan images from another program: an initial estimate, which the matches have to confirm.

    Attributes:
        Ts_scan_cam: Pose (4, 4) by image name, OpenCV axes.
        metric: Whether they are in metres; else their scale is unknown.
    """

    Ts_scan_cam: dict[str, Array]
    metric: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A validated capture, format 1.

    Attributes:
        folder: The capture's folder.
        name, category, instruction: From capture.toml.
        robot: The robot and its state during the scan.
        scan_images: Paths in name order; none when the scan is a video.
        scan_video: The scan when it is a video, or None.
        scan_size: Width and height of every scan image, [px].
        scan_intrinsics: Known intrinsics of the scan, or None.
        cameras: The demonstration's fixed cameras.
        joint_log: Arm and gripper over the log's clock.
        joint_log_file: File of the joint log.
        clock_offset_s: Known offset (log time = video time + offset), or None.
        prompts: A person's annotations.
        mask_folders: Folders below `masks/`, by name.
        notes: Sentences about what the readers skipped, sorted, merged or unwrapped.
        scan_poses: Poses of scan images that are part of the capture, or None.
    """

    folder: Path
    name: str
    category: str
    instruction: str
    robot: RobotChoice
    scan_images: tuple[Path, ...]
    scan_video: Path | None
    scan_size: tuple[int, int]
    scan_intrinsics: Intrinsics | None
    cameras: tuple[DemoCamera, ...]
    joint_log: JointLog
    joint_log_file: Path
    clock_offset_s: float | None
    prompts: tuple[Prompt, ...]
    mask_folders: dict[str, Path]
    notes: tuple[str, ...] = ()
    scan_poses: ScanPoses | None = None
