"""The estimated motion of the object's moving part: joint, joint values over time, contacts."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.joint import Joint
from aomgen.core.values import Array, Vector3, freeze_arrays

Direction = Literal["opening", "closing"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactPatch:
    """Contact of one finger with the moving part at the start of the motion.

    Attributes:
        finger: "left", "right", "palm"; "hand" if the fingers are unknown.
        point: Center of the patch on the finger's surface (3,), world frame, [m].
        normal: Unit direction from the finger into the part (3,), world frame.
        spread_m: RMS distance of the patch from its center, [m].
        gap_m: Distance between finger and reconstructed part there, [m]; it includes the error of the alignment.
    """

    finger: str
    point: Vector3
    normal: Vector3
    spread_m: float
    gap_m: float

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionCurve:
    """The motion score over the video, for the report.

    Attributes:
        times_s: Times (T,), video clock, [s].
        scores: Raw scores (T,), 0..1, never NaN.
        smoothed: Scores after Savitzky-Golay smoothing (T,).
        threshold: Score above which a frame starts a motion interval.
        distances_m: Smallest distance between fingers and part at its scanned pose (T,), [m].
        speeds_m_s: End-effector speeds (T,), [m/s].
        gripper: Gripper (T,), 0 open .. 1 closed.
    """

    times_s: Annotated[Array, "T"]
    scores: Annotated[Array, "T"]
    smoothed: Annotated[Array, "T"]
    threshold: float
    distances_m: Annotated[Array, "T"]
    speeds_m_s: Annotated[Array, "T"]
    gripper: Annotated[Array, "T"]

    __post_init__ = freeze_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionEstimate:
    """The estimated motion of the articulated object, in video time and in the world frame.

    Attributes:
        clock_offset_s: Joint log time minus video time, [s].
        clock_offset_sd_s: Standard deviation of the offset, [s]; 0 if it was stated.
        start_s, end_s: Times at which the part starts and stops moving, [s].
        curve: Motion score over the video, which determines start and end.
        contacts: One patch for each finger in contact.
        grasp_ee: Grasp point on the part (3,), end-effector frame, [m].
        joint: Joint; value 0 is the scanned state, and the axis is positive in the demonstrated direction.
        axis_sd_rad: Standard deviation of the axis direction, [rad].
        origin_sd_m: Standard deviation of the position of the axis line near the contact, [m].
        axis_ci95_rad: Angle around `joint.axis` that contains the true direction with a probability of 95 %, [rad].
        origin_ci95_m: Distance from the axis line, near the contact, within which the true line is with a probability
            of 95 %, [m]; 0 for a prismatic joint, whose axis has no position.
        type_margin: Twice the difference in log evidence between the chosen joint type and the other one.
        ee_turn_ratio: Ratio of the end effector's rotation to that of the part: 1 for a rigid grasp, 0 if the handle
            rotates in the fingers, and 0 (not NaN) for a prismatic joint.
        times_s: Times of the video frames (T,), [s].
        thetas: Joint value at each time (T,), [rad] or [m].
        theta_sd: Standard deviation of each joint value (T,), [rad] or [m].
        slip_m: Slip of the grasp point along the part since the start (T,), [m]; 0 outside the motion.
        pivot_rad: Rotation of the end effector relative to the part since the start (T,), [rad]; 0 outside the motion.
        direction: "opening" if the part ends more open than in the scan, else "closing".
        part_odds: Likelihood ratio, from contact and video, between the prompted part and the best other region as the
            moving part.
    """

    clock_offset_s: float
    clock_offset_sd_s: float
    start_s: float
    end_s: float
    curve: MotionCurve
    contacts: tuple[ContactPatch, ...]
    grasp_ee: Vector3
    joint: Joint
    axis_sd_rad: float
    origin_sd_m: float
    axis_ci95_rad: float
    origin_ci95_m: float
    type_margin: float
    ee_turn_ratio: float
    times_s: Annotated[Array, "T"]
    thetas: Annotated[Array, "T"]
    theta_sd: Annotated[Array, "T"]
    slip_m: Annotated[Array, "T"]
    pivot_rad: Annotated[Array, "T"]
    direction: Direction
    part_odds: float

    __post_init__ = freeze_arrays

    def theta_at(self, times_s: ArrayLike) -> Array:
        """Interpolate joint values linearly at video times (N,), [s]; they are constant outside of the video."""
        return np.interp(np.asarray(times_s, np.float64), self.times_s, self.thetas)
