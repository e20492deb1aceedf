"""Result of the calibration: the similarity between reconstruction and world, fixed cameras, and their clocks."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.camera import Camera
from aomgen.core.values import Array, Matrix4, freeze_arrays
from aomgen.errors import SyncError


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Relation of two clocks: log time = video time + `offset_s` + `rate` * (video time - `middle_s`).

    Attributes:
        offset_s: Offset at the middle of the video, [s].
        sd_s: Standard deviation of the offset, [s]; 0 if the offset was given.
        rate: Relative drift; with 0.01, the log's clock advances by 1.01 s per second of the video.
        rate_sd: Standard deviation of the drift.
        middle_s: Video time at which `rate` contributes nothing, [s].
    """

    offset_s: float
    sd_s: float = 0.0
    rate: float = 0.0
    rate_sd: float = 0.0
    middle_s: float = 0.0

    def log_times(self, video_times_s: ArrayLike) -> Array:
        """Convert video times (N,) to log times (N,), [s]."""
        times = np.asarray(video_times_s, np.float64)
        return times + self.offset_s + self.rate * (times - self.middle_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCamera:
    """A calibrated fixed camera, and the clock of its video.

    Attributes:
        camera: Intrinsics and pose, world frame.
        clock: Clock of its video relative to the joint log; None if the estimate was refused.
        refusal: Location, problem and remedy of the refused clock; empty otherwise.
        note: Description of the method that estimated the pose.
        trusted: Whether all information about the camera is consistent.
        figures: Metrics by name.
    """

    camera: Camera
    clock: Clock | None
    refusal: tuple[str, ...] = ()
    note: str = ""
    trusted: bool = True
    figures: dict[str, float] = field(default_factory=dict)

    def require_clock(self) -> Clock:
        """Return the clock.

        Raises:
            SyncError: The clock was refused; the error states the original reason.
        """
        if self.clock is None:
            raise SyncError(*self.refusal)
        return self.clock

    def summary(self) -> dict[str, object]:
        """Return metrics for the manifest."""
        clock = {} if self.clock is None else {"offset_s": self.clock.offset_s, "sd_s": self.clock.sd_s}
        return {"note": self.note, "clock": clock or "; ".join(self.refusal), **self.figures}

    def warnings(self, name: str) -> list[str]:
        """List warnings for the user."""
        found = [] if self.trusted else [f"camera '{name}' {self.note}"]
        return found + ([f"camera '{name}': {'; '.join(self.refusal)}"] if self.refusal else [])


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The similarity between reconstruction and world, and its confidence.

    Attributes:
        S_world_recon: Similarity (4, 4), including the scale in meters per recon unit.
        support: Share of outline points, over all views, that are confirmed by image edges within 2 px.
        chance: The same share for displaced outlines.
        runner_up_support: The same share for the best different hypothesis; 0 if there was none.
        residual_px: Median distance of confirmed outline points from image edges.
        residual_px_of_view: The same for each view in which enough of the robot is visible.
        ee_sd_m: Standard deviation of the end-effector position, [m].
        joint_zeros_rad: Offset to be added to each joint of the log (J,), [rad], or [m] for a prismatic joint, see
            `calibrate_fixed_cameras`; 0 without evidence for an offset, empty before the estimation.
        joint_zero_sds_rad: Standard deviations of these offsets (J,).
        cameras: Fixed cameras by name; empty before the calibration.
    """

    S_world_recon: Matrix4
    support: float
    chance: float
    runner_up_support: float
    residual_px: float
    residual_px_of_view: dict[str, float]
    ee_sd_m: float
    joint_zeros_rad: Annotated[Array, "J"] = field(default_factory=lambda: np.zeros(0))
    joint_zero_sds_rad: Annotated[Array, "J"] = field(default_factory=lambda: np.zeros(0))
    cameras: dict[str, FixedCamera] = field(default_factory=dict)

    __post_init__ = freeze_arrays
