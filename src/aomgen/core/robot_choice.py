"""Which robot a recording belongs to, as its folder says."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from aomgen.core.values import Array, freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotChoice:
    """Which robot model the log belongs to, and its state during the scan.

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
