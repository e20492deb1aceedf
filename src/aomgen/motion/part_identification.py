"""Whether the prompted part is the one that moved: what the gripper held, and what looked different after.

Prompts say which part moves. People swap parts, or draw boxes around the body or another object; the
demonstration then contradicts them twice, by where the fingers closed and by what changed in the video.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.errors import WrongPromptError
from aomgen.motion.gripper_signals import GripperSignals, TouchInterval, find_touch
from aomgen.motion.keyframes import count_reference_frames, measure_change
from aomgen.splatting.rasterizer import render

# Reconstructed surfaces are off by this much where they are thin, as handles are, [m].
_SURFACE_M = 0.01
# Share of a standing part's picture that changes all the same: shadows of the arm and of the part.
_STILL_SHARE = 0.05
# A part that shows fewer pixels than this tells nothing about change.
_MIN_PIXELS = 30
# Odds below which prompts are doubted, and below whose inverse they are refused. On captures with right
# prompts the odds are 5 and more; swapped ones reach 0.15, boxes around the whole object 0.5.
MIN_ODDS = 2.0


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
        """How well the part fits as the one that moved: near the gripper and changed."""
        return (self.changed + _STILL_SHARE) / (self.gap_m + _SURFACE_M)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartIdentification:
    """The three candidates: prompted as moving, prompted as static, everything else.

    Of everything else only the contact speaks; its change is taken to be a standing part's.
    `gripped`: The gripper closed near one of them.
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
        near = f"the fingers closed {1e3 * self.moving.gap_m:.0f} mm from 'moving' and "
        changed = f"the video changed {100 * self.moving.changed:.0f} % of 'moving'"
        if self.static.weight >= self.other.weight:
            raise WrongPromptError(
                "prompts of the moving part",
                f"what the hand moved is the part prompted as 'static': {near}{1e3 * self.static.gap_m:.0f} mm "
                f"from 'static', and {changed} and {100 * self.static.changed:.0f} % of 'static'",
                "in capture.toml, swap the boxes of 'moving' and 'static', or draw 'moving' around the door or "
                "drawer alone",
            )
        raise WrongPromptError(
            "prompts of the moving part",
            f"what the hand moved is neither part: {near}{1e3 * self.other.gap_m:.0f} mm from something "
            f"unprompted, and {changed}",
            "in capture.toml, draw 'moving' around the part that the robot moves and 'static' around the rest of it",
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
    scene: Gaussians,
    labels: NDArray[np.uint8],
    signals: tuple[GripperSignals, GripperSignals, GripperSignals],
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
    camera: Camera,
) -> PartIdentification:
    """Look at contact and change of the three candidates.

    Args:
        scene, labels: As scanned (G).
        signals: The gripper's distances to the moving part, the static part and everything else, at the frames' times.
        frames_srgb: Small frames of the demonstration (T, H, W, 3).
        robot: The robot's masks (T, H, W) in them.
        camera: Of these frames, world frame.

    Source: AOMGen, sec. 4.1: the movable part is the one that the gripper touches.
    Not checked: that the prompted box holds the whole part.
    """
    touch = _find_touch(signals)
    reference = count_reference_frames(signals[0].times_s)
    change, seen = measure_change(frames_srgb, robot, touch, reference)
    shares = [
        float(change[region & seen].mean()) if np.sum(region & seen) >= _MIN_PIXELS else _STILL_SHARE
        for region in find_visible_regions(scene, labels, camera)
    ]
    gaps = [
        float(item.distances_m[touch.first] if touch.gripped else item.distances_m.min()) for item in signals
    ]
    moving, static, other = (
        CandidateEvidence(gap_m=gap, changed=changed)
        for gap, changed in zip(gaps, (*shares, _STILL_SHARE), strict=True)
    )
    return PartIdentification(moving=moving, static=static, other=other, gripped=touch.gripped)


def _find_touch(signals: tuple[GripperSignals, ...]) -> TouchInterval:
    """The grasp near the prompted part, else near anything; the whole video for grippers that do not grasp."""
    nearest = np.min([item.distances_m for item in signals], axis=0)
    for candidate in (signals[0], replace(signals[0], distances_m=nearest)):
        touch = find_touch(candidate)
        if touch.gripped:
            return touch
    return TouchInterval(first=0, last=len(nearest) - 1, gripped=False)


def find_visible_regions(
    scene: Gaussians, labels: NDArray[np.uint8], camera: Camera
) -> list[NDArray[np.bool_]]:
    """Pixels (H, W) that show mostly the moving part, and those that show mostly the static part."""
    bare = labels != ROBOT
    parts = np.stack([labels == MOVING, labels == STATIC], 1)[bare].astype(np.float32)
    shown = np.asarray(render(scene.select(bare), camera, features=parts).features)
    return [shown[..., 0] > 0.5, shown[..., 1] > 0.5]
