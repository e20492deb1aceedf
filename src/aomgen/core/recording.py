"""The validated content of a capture folder."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.core.lens import Lens
from aomgen.core.values import Array, Matrix4, freeze_arrays

# File that describes a capture, in its folder.
CAPTURE_FILE: Final = "capture.toml"
# Relative standard deviation of a focal length from a data sheet: lenses differ between specimens and with focus.
STATED_FOCAL_SD = 0.02
# Relative standard deviation of a focal length that was calibrated with a target.
CALIBRATED_FOCAL_SD = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class JointLog:
    """Log of arm joints and gripper.

    Attributes:
        times_s: Times (T,), strictly increasing, on the log's clock, [s].
        joints: Arm joints (T, J), [rad] or [m], in the order of `joint_names`.
        gripper: Gripper (T,), 0 open .. 1 closed.
        joint_names: Names of the J joints.
    """

    times_s: Annotated[Array, "T"]
    joints: Annotated[Array, "T N"]
    gripper: Annotated[Array, "T"]
    joint_names: Annotated[tuple[str, ...], "N"]

    __post_init__ = freeze_arrays

    def at(self, times_s: ArrayLike) -> tuple[Array, Array]:
        """Interpolate joints (N, J) and gripper (N,) linearly at log times (N,), [s]; both are constant outside of the log."""
        times = np.asarray(times_s, np.float64)
        columns = [np.interp(times, self.times_s, column) for column in self.joints.T]
        return np.stack(columns, -1), np.interp(times, self.times_s, self.gripper)

    def shift(self, offset_s: float) -> "JointLog":
        """Convert the log to a clock that is behind the log's clock by an offset, [s]."""
        return replace(self, times_s=self.times_s - offset_s)

    def covers(self, times_s: ArrayLike) -> NDArray[np.bool_]:
        """Return the mask (N,) of the times (N,), [s], within the log."""
        times = np.asarray(times_s, np.float64)
        return (times >= self.times_s[0]) & (times <= self.times_s[-1])


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotChoice:
    """The robot model of the log, and its state during the scan.

    Attributes:
        model: Name of a known robot, or "" if `model_file` is given.
        model_file: URDF or MJCF file in the capture, or None.
        root: Folder that contains all files to which `model_file` refers.
        references: All files to which `model_file` refers.
        base_frame: Frame of the log and of given camera poses: "base_link" or "ur_base".
        joints: Names (J) of the arm joints in the order of the log.
        scan_joints: Joint values (J,) during the scan, [rad] or [m].
        scan_gripper: Gripper during the scan, 0 open .. 1 closed.
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
    """Return the image name of a frame of a scan video; the alphabetical order of names is that of the frames."""
    return f"scan_{index:06d}.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Stated intrinsics, [px], with pixel centers at +0.5; they are used as a prior.

    Attributes:
        fx, fy, cx, cy: Focal lengths and principal point, [px].
        distortion: Stated k1, k2, p1, p2 (see `Lens`); None if unknown.
        calibrated: The intrinsics were measured with a target instead of taken from a data sheet or another setting.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] | None = None
    calibrated: bool = False

    def lens(self, width: int, height: int) -> Lens:
        """Return the lens for images of a size, [px]; it has no distortion if none is stated."""
        k1, k2, p1, p2 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        return Lens(
            fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=width, height=height, k1=k1, k2=k2, p1=p1, p2=p2
        )  # fmt: skip

    @property
    def focal_sd(self) -> float:
        """Relative standard deviation of the focal length."""
        return CALIBRATED_FOCAL_SD if self.calibrated else STATED_FOCAL_SD


@dataclass(frozen=True, slots=True, kw_only=True)
class Prompt:
    """A person's annotation of one part on one scan image.

    Attributes:
        part: "robot", "moving" or "static".
        image: File name of the scan image.
        points: Points (N, 3): x, y, [px], and a label, 1 for points on the part, 0 for points outside of it.
        box: Box (4,): x0, y0, x1, y1, [px]; empty (0,) if none was given.
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
        name: Name, for example "front".
        video: Path of its video.
        intrinsics: Known intrinsics; None if they have to be estimated.
        T_world_cam: Pose from a known hand-eye calibration (4, 4), or None.
        lens: Distortion of the video's frames, which are undistorted when they are read; None without distortion.
    """

    name: str
    video: Path
    intrinsics: Intrinsics | None
    T_world_cam: Matrix4 | None
    lens: Lens | None = None

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanPoses:
    """Poses of scan images from another program, which are initial values that feature matches must confirm.

    Attributes:
        Ts_scan_cam: Pose (4, 4) by image name, OpenCV axes.
        metric: Whether the poses are in meters; otherwise their scale is unknown.
    """

    Ts_scan_cam: dict[str, Array]
    metric: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A validated capture, format 1.

    Attributes:
        folder: The capture's folder.
        name, category, instruction: Values of capture.toml.
        robot: The robot and its state during the scan.
        scan_images: Paths of the scan images in name order; empty if the scan is a video.
        scan_video: Path of the scan video, or None.
        scan_size: Width and height of every scan image, [px].
        scan_intrinsics: Known intrinsics of the scan, or None.
        cameras: The demonstration's fixed cameras.
        joint_log: Log of arm and gripper, on its own clock.
        joint_log_file: File of the joint log.
        clock_offset_s: Known offset of the first camera, [s] (log time = video time + offset), or None.
        prompts: A person's annotations.
        mask_folders: Folders below `masks/`, by name.
        notes: Sentences about data that were skipped, sorted, merged or unwrapped when they were read.
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
