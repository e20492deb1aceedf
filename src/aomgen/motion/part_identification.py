"""Whether the prompted part is the one that moved: what the hand held, and what looked different after.

Prompts say which part moves. People swap parts, or draw boxes around the body or another object; the
demonstration then contradicts them twice, by where the fingers closed and by what changed in the video.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.values import Array
from aomgen.errors import WrongPromptError
from aomgen.motion.filters import minimum_around
from aomgen.motion.gripper_signals import GripperSignals, TouchInterval, find_touch
from aomgen.motion.keyframes import count_reference_frames, find_part_region, measure_change

# Reconstructed surfaces are off by this much where they are thin, as handles are, [m].
SURFACE_M = 0.01
# Share of a standing part's picture that changes all the same: shadows of the arm and of the part.
STILL_SHARE = 0.05
# A part that shows fewer pixels than this tells nothing about change.
MIN_PIXELS = 30
# Odds below which prompts are doubted, and below whose inverse they are refused. On captures with right
# prompts the odds are 5 and more; swapped ones reach 0.15, boxes around the whole object 0.5.
MIN_ODDS = 2.0
# Neighborhood in which points of a surface are its pixels, as in `find_part_region`, [px].
SPACING_PX = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateEvidence:
    """What the demonstration shows of one part at its scanned place.

    Attributes:
        gap_m: Distance of the fingers from it when they took hold, [m].
        changed: Share of its visible pixels that look different after the touch.
    """

    gap_m: float
    changed: float

    @property
    def weight(self) -> float:
        """How well the part fits as the one that moved: near the hand and changed."""
        return (self.changed + STILL_SHARE) / (self.gap_m + SURFACE_M)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartIdentification:
    """The three candidates: prompted as moving, prompted as static, everything else.

    Of everything else only the contact speaks; its change is taken to be a standing part's.

    Attributes:
        moving, static, other: Their signs.
        gripped: The hand closed near one of them.
    """

    moving: CandidateEvidence
    static: CandidateEvidence
    other: CandidateEvidence
    gripped: bool

    @property
    def odds(self) -> float:
        """How many times better "moving" fits than the better of its rivals."""
        return self.moving.weight / max(self.static.weight, self.other.weight, 1e-9)

    def check(self) -> None:
        """Refuse prompts that the demonstration contradicts.

        Raises:
            WrongPromptError: Another part fits clearly better.
        """
        if self.odds * MIN_ODDS >= 1.0:
            return
        swapped = self.static.weight >= self.other.weight
        rival, signs = (
            ("the part prompted as 'static'", self.static) if swapped else ("neither part", self.other)
        )
        gap = f"{1e3 * signs.gap_m:.0f} mm from " + ("'static'" if swapped else "something unprompted")
        changed = f"{100 * self.moving.changed:.0f} % of 'moving'"
        changed += f" and {100 * signs.changed:.0f} % of 'static'" if swapped else ""
        raise WrongPromptError(
            "prompts of the moving part",
            f"what the hand moved is {rival}: the fingers closed {1e3 * self.moving.gap_m:.0f} mm from 'moving' "
            f"and {gap}, and the video changed {changed}",
            "in capture.toml, "
            + (
                "swap the boxes of 'moving' and 'static', or draw 'moving' around the door or drawer alone"
                if swapped
                else "draw 'moving' around the part that the robot moves and 'static' around the rest of it"
            ),
        )


def list_warnings(odds: float) -> list[str]:
    """Sentences about prompts that the demonstration does not clearly confirm."""
    if odds >= MIN_ODDS:
        return []
    return [
        f"contact and video fit the part prompted as 'moving' only {odds:.1f} times as well as anything else, "
        f"want {MIN_ODDS:.0f}; check its boxes in capture.toml"
    ]


def identify_part(
    points: tuple[Array, Array, Array],
    signals: tuple[GripperSignals, GripperSignals, GripperSignals],
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    camera: Camera,
) -> PartIdentification:
    """Look at contact and change of the three candidates.

    Args:
        points: Of the moving part, the static part and everything else (N, 3), as scanned, world frame, [m].
        signals: The hand's distances to each, at the frames' times.
        frames_srgb: Small frames of the demonstration (T, H, W, 3).
        robot: The robot's masks (T, H, W) in them.
        camera: Of these frames, world frame.

    Source: DESIGN.md, section 4, "Parts": the movable part is the one that the gripper touches.
    Not checked: that the prompted box holds the whole part.
    """
    touch = _touch(signals)
    reference = count_reference_frames(signals[0].times_s)
    change, seen = measure_change(frames_srgb, robot, touch, reference)
    shares = [
        float(change[shown].mean()) if shown.sum() >= MIN_PIXELS else STILL_SHARE
        for shown in (region & seen for region in find_visible_regions(points[:2], camera))
    ]
    gaps = [
        float(item.distances_m[touch.first] if touch.gripped else item.distances_m.min()) for item in signals
    ]
    moving, static, other = (
        CandidateEvidence(gap_m=gap, changed=changed)
        for gap, changed in zip(gaps, (*shares, STILL_SHARE), strict=True)
    )
    return PartIdentification(moving=moving, static=static, other=other, gripped=touch.gripped)


def _touch(signals: tuple[GripperSignals, ...]) -> TouchInterval:
    """The grasp near the prompted part, else near anything; the whole video for hands that do not grasp."""
    nearest = np.min([item.distances_m for item in signals], axis=0)
    for candidate in (signals[0], replace(signals[0], distances_m=nearest)):
        touch = find_touch(candidate)
        if touch.gripped:
            return touch
    return TouchInterval(first=0, last=len(nearest) - 1, gripped=False)


def find_visible_regions(points: tuple[Array, ...], camera: Camera) -> list[NDArray[np.bool_]]:
    """Pixels (H, W) of each part where it is in front of the others.

    Args:
        points: Points (N, 3) of each part, world frame, [m].
        camera: World frame.
    """
    nearest = np.full((len(points), camera.height, camera.width), np.inf)
    for depth, part in zip(nearest, points, strict=True):
        pixels, depths = camera.project(part)
        inside = (depths > 0) & np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
        columns, rows = pixels[inside].astype(int).T
        np.minimum.at(depth, (rows, columns), depths[inside])
        depth[:] = minimum_around(depth, SPACING_PX)
    front = nearest.min(axis=0)
    return [
        find_part_region(part, camera) & (depth == front) & np.isfinite(front)
        for part, depth in zip(points, nearest, strict=True)
    ]
