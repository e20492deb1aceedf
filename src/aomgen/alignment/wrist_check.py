"""Check of the last wrist joint: its rotation hardly moves the contour of anything but the gripper.

Small errors of a joint show in where edges lie, see `uncertainty.joint_offsets`. A gripper
that is rotated far leaves the search reach, and part of its contour is confirmed by chance; so other
rotations are rendered, too.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from aomgen.alignment.confidence import ViewEvidence, collect_evidence
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.silhouette_fit import RobotDrawing
from aomgen.core.values import Array

# Beyond the reach of edges, and close enough together that one of them is near any turn. A parallel
# gripper looks alike after half a turn.
TURNS_DEG: Final = (-60.0, -30.0, -15.0, 15.0, 30.0, 60.0, 90.0)
# Neighbors on an outline are confirmed together: ten count as one.
CORRELATED: Final = 10
# Standard deviations by which a rotated wrist must fit better, so that chance does not report one.
CLEAR_SDS: Final = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class WristRotation:
    """Rotation of the last joint that the images confirm best, among those rendered.

    Attributes:
        turn_rad: Against the log; 0 when the log's is best.
        gain: How much larger the share of confirmed outline is there than as logged.
        gain_sd: Standard deviation of that.
    """

    turn_rad: float
    gain: float
    gain_sd: float

    @property
    def clear(self) -> bool:
        """Whether the images contradict the log."""
        return self.gain > CLEAR_SDS * self.gain_sd


def find_wrist_rotation(
    S: Array,
    views: list[AlignmentImage],
    drawing: RobotDrawing,
    contour_points: int,
    logged: list[ViewEvidence],
) -> WristRotation:
    """Render the gripper at several rotations of the last joint and compare how far images confirm it.

    Args:
        S: `S_world_recon`.
        views: Images.
        drawing: Draws the robot as logged.
        contour_points: Outline points a view.
        logged: What the images say of the robot as logged; of these views and perhaps more.

    Not checked: the last joint turns (one that slides finds no better turn).
    """
    hand = len(drawing.configuration.joints)

    names = {view.name for view in views}

    def confirmed(evidence: list[ViewEvidence]) -> tuple[float, int]:
        seen = [view.confirmed[view.segments == hand] for view in evidence if view.name in names]
        points = np.concatenate(seen) if seen else np.zeros(0, np.bool_)
        return (float(points.mean()), len(points)) if len(points) else (0.0, 0)

    def turned(turn_deg: float) -> RobotDrawing:
        joints = drawing.configuration.joints.copy()
        joints[-1] += np.radians(turn_deg)
        return replace(drawing, configuration=replace(drawing.configuration, joints=joints))

    own, count = confirmed(logged)
    shares = [confirmed(collect_evidence(S, views, turned(turn), contour_points))[0] for turn in TURNS_DEG]
    best = int(np.argmax(shares))
    if count == 0 or shares[best] <= own:
        return WristRotation(turn_rad=0.0, gain=0.0, gain_sd=0.0)
    variance = (own * (1 - own) + shares[best] * (1 - shares[best])) * CORRELATED / count
    return WristRotation(
        turn_rad=float(np.radians(TURNS_DEG[best])), gain=shares[best] - own, gain_sd=float(np.sqrt(variance))
    )
