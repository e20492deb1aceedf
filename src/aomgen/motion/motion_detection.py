"""Detection of whether a part moved at all, and whether it was the prompted one.

The scene is rendered with the part carried by the gripper, and the changes in these renderings are compared
with those in the video. A part that follows the gripper changes the video in the same manner; a resting one
does not, whatever shadows or the exposure do. Changes of less than a pixel count.

Prompts name the part that moves. They may be swapped, or boxes may be drawn around the body or
another object; the demonstration then contradicts them twice, by where the fingers closed and by
what changed in the video.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.errors import NoMotionError, WrongPromptError
from aomgen.motion.inputs import NEAR_M, GripperSignals, TouchInterval, find_touch
from aomgen.motion.keyframes import STILL_M, measure_change
from aomgen.splatting.rasterizer import RigidParts, render
from aomgen.splatting.session import RenderSession

# The image of a resting part changes too, by shadows of the arm and of the part: mean share.
_SHADOWS = 0.05
# Largest log-likelihood ratio of change alone, 20 to 1: shadows come in all sizes.
_MOST = 3.0
# A moving part follows the rendering with the gripper by this mean share and standard deviation; a resting
# one seems to follow by chance, because of shadows: standard deviation.
_FOLLOWS, _FOLLOWS_SD, _CHANCE_SD = 0.7, 0.35, 0.12
# Number of renderings, spread over the touch.
_DRAWINGS = 12
# Differences are clipped here, so that few bright pixels do not dominate, 8 bit.
_CUT = 60.0
# Noise of one pixel's difference, 8 bit, and number of neighboring pixels that share it.
_NOISE, _SHARED = 3.0, 9.0
# Error of reconstructed thin surfaces such as handles, [m].
_SURFACE_M = 0.01
# A part that shows fewer pixels than this gives no evidence of change.
_MIN_PIXELS = 30
# Prompts with a likelihood ratio below MIN_ODDS cause a warning; prompts below 1 / MIN_ODDS are refused. Measured ratios: correct
# prompts at least 5, swapped prompts at most 0.15, boxes around the whole object at most 0.5.
MIN_ODDS = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionEvidence:
    """Evidence for and against a motion.

    Attributes:
        changed: Largest share of the part's pixels that show neither its first nor its last appearance.
        followed, followed_sd: Result of `estimate_following`.
        nearest_m: Smallest distance of the fingers to the part, [m].
        travel_m: Path length of the gripper during the touch, [m].
        video_margin: Twice the log evidence of the video for the recovered motion over a part at rest; 0 before the
            motion is recovered.
    """

    changed: float
    followed: float
    followed_sd: float
    nearest_m: float
    travel_m: float
    video_margin: float = 0.0

    @property
    def log_likelihood_ratio(self) -> float:
        """Natural logarithm of the likelihood ratio of a motion over none."""
        # Densities: 1 over 0..1 if it moved, exponential with mean _SHADOWS if not.
        change = float(np.clip(self.changed / _SHADOWS + np.log(_SHADOWS), -_MOST, _MOST))
        seen = change + self.video_margin / 2
        share, noise = self.followed, self.followed_sd
        if not (np.isfinite(noise) and self.travel_m > STILL_M):
            return seen
        moved, stood = np.hypot(_FOLLOWS_SD, noise), np.hypot(_CHANCE_SD, noise)
        pull = (share / stood) ** 2 / 2 - ((share - _FOLLOWS) / moved) ** 2 / 2 + np.log(stood / moved)
        return seen + float(np.clip(pull, -2 * _MOST, 2 * _MOST))

    def check(self) -> None:
        """Refuse a demonstration in which the part rests.

        Raises:
            NoMotionError: The gripper never approaches the part, or the part does not move.
        """
        if not self.nearest_m <= NEAR_M:
            raise NoMotionError(
                "demonstration video",
                f"the gripper never touches the part: its distance is at least {100 * self.nearest_m:.0f} cm, "
                f"limit {100 * NEAR_M:.0f} cm",
                "check the 'moving' prompts, and that video and joint log show the same demonstration",
            )
        if self.log_likelihood_ratio > 0:
            return
        pulled = f"the gripper moves {1e3 * self.travel_m:.0f} mm while it is near the part"
        if np.isfinite(self.followed_sd):
            pulled += f", the part follows by {100 * max(self.followed, 0.0):.0f} % of that"
        if self.video_margin < 0:
            pulled += ", the video fits a part at rest better than the recovered motion"
        raise NoMotionError(
            "demonstration video",
            f"the part does not move: {pulled}, and {100 * self.changed:.0f} % of its pixels change in between "
            f"(likelihood ratio of a motion {np.exp(self.log_likelihood_ratio):.2g}, need 1)",
            "check that the video shows the whole motion, that the part is not locked, and the 'moving' prompts",
        )


def estimate_following(
    scene: Gaussians,
    labels: NDArray[np.uint8],
    camera: Camera,
    frames_srgb: NDArray[np.uint8],
    hidden: NDArray[np.bool_],
    Ts_world_ee: Array,
) -> tuple[float, float]:
    """Compare the video of a touch with renderings in which the part moves with the gripper.

    Args:
        scene, labels: Scene as scanned, with the part at its pose in the first frame.
        camera, frames_srgb: Frames (T, H, W, 3) of one exposure, without bad ones.
        hidden, Ts_world_ee: Masks of the robot (T, H, W), and end-effector poses (T, 4, 4).

    Returns:
        Share by which the part follows, about 1 when it moves with the gripper and 0 when it rests, and its
        standard deviation from the noise of the images, infinite when nothing is visible.

    Not checked: how the part rotates with the gripper. It is rendered rotating with it and not rotating
    at all, and the better rendering counts.
    """
    if len(frames_srgb) < 3:
        return 0.0, np.inf
    session = RenderSession(scene.select((labels != MOVING) & (labels != ROBOT)), camera)
    moving = scene.select(labels == MOVING)
    first = _draw(session, moving, np.eye(4))
    before = np.median(frames_srgb[:2].astype(np.float32), axis=0)
    sums = np.zeros((2, 2))
    for k in np.unique(np.linspace(2, len(frames_srgb) - 1, _DRAWINGS).astype(int)):
        seen = ~hidden[[0, 1, k]].any(0)
        observed = np.clip(frames_srgb[k] - before, -_CUT, _CUT)[seen]
        T_carried = Ts_world_ee[k] @ np.linalg.inv(Ts_world_ee[0])
        T_shifted = np.eye(4)
        T_shifted[:3, 3] = Ts_world_ee[k, :3, 3] - Ts_world_ee[0, :3, 3]
        for row, T in enumerate((T_carried, T_shifted)):
            change = np.clip(_draw(session, moving, T) - first, -_CUT, _CUT)[seen]
            sums[row] += np.sum(observed * change), np.sum(change**2)
    together, alone = max(sums, key=lambda row: row[0] / np.sqrt(max(row[1], 1e-9)))
    if not alone > 0:
        return 0.0, np.inf
    return float(together / alone), float(_NOISE * np.sqrt(_SHARED / alone))


def _draw(session: RenderSession, moving: Gaussians, T: Array) -> NDArray[np.float32]:
    """Render the scene (H, W, 3), 0..255, with the part moved by a transform."""
    parts = RigidParts(indices=np.zeros(len(moving), np.int32), Ts_world_part=T[None])
    return 255 * session.draw(moving, parts).rgb


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateEvidence:
    """Evidence of the demonstration about one part at its scanned pose.

    Attributes:
        gap_m: Distance of the fingers from it when they closed, [m].
        changed: Share of its visible pixels that look different after the touch.
    """

    gap_m: float
    changed: float

    @property
    def weight(self) -> float:
        """Weight of the part as the one that moved: large near the gripper and where the video changed."""
        return (self.changed + _SHADOWS) / (self.gap_m + _SURFACE_M)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartIdentification:
    """The three candidates: prompted as moving, prompted as static, everything else.

    For everything else only the contact is evidence; its change is assumed to be that of a resting part.
    `gripped`: The gripper closed near one of them.
    """

    moving: CandidateEvidence
    static: CandidateEvidence
    other: CandidateEvidence
    gripped: bool

    @property
    def odds(self) -> float:
        """Likelihood ratio of "moving" over the better of its rivals."""
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
                f"the gripper moved the part that is prompted as 'static': {near}{1e3 * self.static.gap_m:.0f} mm "
                f"from 'static', and {changed} and {100 * self.static.changed:.0f} % of 'static'",
                "in capture.toml, swap the boxes of 'moving' and 'static', or draw 'moving' around the door or "
                "drawer alone",
            )
        raise WrongPromptError(
            "prompts of the moving part",
            f"the object that the gripper moved is neither part: {near}{1e3 * self.other.gap_m:.0f} mm from an "
            f"unprompted region, and {changed}",
            "in capture.toml, draw 'moving' around the part that the robot moves and 'static' around the rest of it",
        )


def list_warnings(odds: float) -> list[str]:
    """List warnings about prompts that the demonstration does not clearly confirm."""
    if odds >= MIN_ODDS:
        return []
    return [
        f"contact and video fit the part prompted as 'moving' only {odds:.1f} times as well as any other region, "
        f"expected {MIN_ODDS:.0f}; check its boxes in capture.toml"
    ]


def identify_part(
    regions: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    signals: GripperSignals,
    rival_distances_m: tuple[Array, Array],
    frames_srgb: NDArray[np.uint8],
    robot: NDArray[np.bool_],
) -> PartIdentification:
    """Measure contact and change of the three candidates.

    Args:
        regions: Pixels of the moving and of the static part, see `find_visible_regions`.
        signals, rival_distances_m: The gripper at the frames' times, and its distances to the static part and
            to everything else (T,), [m].
        frames_srgb, robot: Small frames of the demonstration (T, H, W, 3), and the robot's
            masks (T, H, W) in them.

    Source: AOMGen, sec. 4.1: the movable part is the one that the gripper touches.
    Not checked: that the prompted box holds the whole part.
    """
    distances = np.stack([signals.distances_m, *rival_distances_m])
    touch = _find_touch(signals, distances.min(0))
    change, seen = measure_change(signals.times_s, frames_srgb, robot, touch)
    shares = [
        float(change[region & seen].mean()) if np.sum(region & seen) >= _MIN_PIXELS else _SHADOWS
        for region in regions
    ]
    gaps = distances[:, touch.first] if touch.gripped else distances.min(1)
    moving, static, other = (
        CandidateEvidence(gap_m=float(gap), changed=changed)
        for gap, changed in zip(gaps, (*shares, _SHADOWS), strict=True)
    )
    return PartIdentification(moving=moving, static=static, other=other, gripped=touch.gripped)


def _find_touch(signals: GripperSignals, nearest_m: Array) -> TouchInterval:
    """Find the grasp near the prompted part, else near any; the whole video if nothing is grasped."""
    for candidate in (signals, replace(signals, distances_m=nearest_m)):
        touch = find_touch(candidate)
        if touch.gripped:
            return touch
    return TouchInterval(first=0, last=len(nearest_m) - 1, gripped=False)


def find_visible_regions(
    scene: Gaussians, labels: NDArray[np.uint8], camera: Camera
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find the pixels (H, W) that show mostly the moving part, and those that show mostly the static part."""
    bare = labels != ROBOT
    parts = np.stack([labels == MOVING, labels == STATIC], 1)[bare].astype(np.float32)
    shown = np.asarray(render(scene.select(bare), camera, features=parts).features)
    return shown[..., 0] > 0.5, shown[..., 1] > 0.5
