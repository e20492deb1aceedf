"""Whether the part moved at all: the picture's change and the gripper's pull weighed together.

The scene is drawn with the part where the gripper would have taken it, and what changes in these drawings is
compared with what changes in the video. A part that follows changes the video just so, one that stands does
not, whatever shadows or the exposure do; changes of less than a pixel count.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.errors import NoMotionError
from aomgen.motion.onset import STILL_M
from aomgen.splatting.rasterizer import RigidParts
from aomgen.splatting.session import RenderSession

# Fingers that stay farther away touch nothing, whatever the alignment's error, [m].
_NEAR_M = 0.10
# A standing part's picture changes all the same, by shadows of the arm: mean share.
_SHADOWS = 0.05
# Change alone never convinces beyond these log odds, 20 to 1: shadows come in all sizes.
_MOST = 3.0
# A part that moves follows the gripper's drawing by this share, and so widely; a standing one seems to
# follow by chance, as shadows fall: standard deviation.
_FOLLOWS, _FOLLOWS_SD, _CHANCE_SD = 0.7, 0.35, 0.12
# Drawings that are made; they are spread over the touch.
_DRAWINGS = 12
# Differences are cut here, so that few bright pixels do not speak for all, 8 bit.
_CUT = 60.0
# Noise of one pixel's difference, 8 bit; neighbors share it over about as many pixels.
_NOISE, _SHARED = 3.0, 9.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowingEstimate:
    """What the video shows of the change that the gripper would make.

    Attributes:
        share: About 1 when the part follows the gripper, 0 when it stands.
        sd: Standard deviation from the noise of the pictures; infinite when there is nothing to see.
    """

    share: float
    sd: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionEvidence:
    """What speaks for and against a motion.

    Attributes:
        changed: Largest share of the part's picture that shows neither its first nor its last place.
        following: How far the part follows the gripper.
        nearest_m: Smallest distance of the fingers to the part, [m].
        travel_m: Way of the gripper during the touch, [m].
    """

    changed: float
    following: FollowingEstimate
    nearest_m: float
    travel_m: float

    @property
    def log_likelihood_ratio(self) -> float:
        """Natural logarithm of how many times more likely a motion is than none."""
        # Densities: 1 over 0..1 if it moved, exponential with mean _SHADOWS if not.
        change = float(np.clip(self.changed / _SHADOWS + np.log(_SHADOWS), -_MOST, _MOST))
        share, noise = self.following.share, self.following.sd
        if not (np.isfinite(noise) and self.travel_m > STILL_M):
            return change
        moved, stood = np.hypot(_FOLLOWS_SD, noise), np.hypot(_CHANCE_SD, noise)
        pull = (share / stood) ** 2 / 2 - ((share - _FOLLOWS) / moved) ** 2 / 2 + np.log(stood / moved)
        return change + float(np.clip(pull, -2 * _MOST, 2 * _MOST))

    def check(self) -> None:
        """Refuse a demonstration in which the part stays where it is.

        Raises:
            NoMotionError: The gripper never comes near, or the part does not move.
        """
        if not self.nearest_m <= _NEAR_M:
            raise NoMotionError(
                "demonstration video",
                f"the hand never touches the part: it stays {100 * self.nearest_m:.0f} cm away, "
                f"limit {100 * _NEAR_M:.0f} cm",
                "check the 'moving' prompts, and that video and joint log show the same demonstration",
            )
        if self.log_likelihood_ratio > 0:
            return
        pulled = f"the hand moves {1e3 * self.travel_m:.0f} mm while it is near the part"
        if np.isfinite(self.following.sd):
            pulled += f", the part follows by {100 * max(self.following.share, 0.0):.0f} % of that"
        raise NoMotionError(
            "demonstration video",
            f"the part does not move: {pulled}, and {100 * self.changed:.0f} % of its picture changes in between "
            f"(odds of a motion {np.exp(self.log_likelihood_ratio):.2g}, need 1)",
            "check that the video shows the whole motion, that the part is not locked, and the 'moving' prompts",
        )


def estimate_following(
    scene: Gaussians,
    labels: NDArray[np.uint8],
    camera: Camera,
    frames_srgb: NDArray[np.uint8],
    hidden: NDArray[np.bool_],
    Ts_world_ee: Array,
) -> FollowingEstimate:
    """Compare the video of a touch with drawings in which the part goes with the gripper.

    Args:
        scene, labels: As scanned, with the part at the place that it has in the first frame.
        camera: Of the frames.
        frames_srgb: (T, H, W, 3), one exposure, without bad frames.
        hidden: Where the robot is (T, H, W).
        Ts_world_ee: The end effector (T, 4, 4).

    Not checked: how the gripper turns in its hold. The part is drawn turning with it and not turning
    at all, and the better drawing counts.
    """
    if len(frames_srgb) < 3:
        return FollowingEstimate(share=0.0, sd=float(np.inf))
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
        return FollowingEstimate(share=0.0, sd=float(np.inf))
    return FollowingEstimate(share=float(together / alone), sd=float(_NOISE * np.sqrt(_SHARED / alone)))


def _draw(session: RenderSession, moving: Gaussians, T: Array) -> NDArray[np.float32]:
    """The scene (H, W, 3), 0..255, with the part moved by a transform."""
    parts = RigidParts(indices=np.zeros(len(moving), np.int32), Ts_world_part=T[None])
    return 255 * session.draw(moving, parts).rgb
