"""How far the part follows the hand, judged by the rendered scene.

The scene is drawn with the part where the hand would have taken it. What changes in these drawings is
compared with what changes in the video: a part that follows changes the video just so, one that stands
does not, whatever shadows or the exposure do. Changes of less than a pixel count.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, ROBOT
from aomgen.core.camera import Camera
from aomgen.core.gaussians import Gaussians
from aomgen.core.values import Array
from aomgen.splatting.rasterizer import RigidParts
from aomgen.splatting.session import RenderSession

# Drawings that are made; they are spread over the touch.
_DRAWINGS = 12
# Differences (8 bit) are cut here, so that few bright pixels do not speak for all.
_CUT = 60.0
# Noise of one pixel's difference, (8 bit); neighbors share it over about as many pixels.
_NOISE, _SHARED = 3.0, 9.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowingEstimate:
    """What the video shows of the change that the hand would make.

    Attributes:
        share: About 1 when the part follows the hand, 0 when it stands.
        sd: Standard deviation from the noise of the pictures; infinite when there is nothing to see.
    """

    share: float
    sd: float


def estimate_following(
    scene: Gaussians,
    labels: NDArray[np.uint8],
    camera: Camera,
    frames_srgb: NDArray[np.uint8],
    hidden: NDArray[np.bool_],
    Ts_world_ee: Array,
) -> FollowingEstimate:
    """Compare the video of a touch with drawings in which the part goes with the hand.

    Args:
        scene, labels: As scanned, with the part at the place that it has in the first frame.
        camera: Of the frames.
        frames_srgb: (T, H, W, 3), one exposure, without bad frames.
        hidden: Where the robot is (T, H, W).
        Ts_world_ee: The hand (T, 4, 4).

    Not checked: how the hand turns in its hold. The part is drawn turning with the hand and not
    turning at all, and the better drawing counts.
    """
    if len(frames_srgb) < 3:
        return FollowingEstimate(share=0.0, sd=float(np.inf))
    session = RenderSession(scene.select((labels != MOVING) & (labels != ROBOT)), camera)
    moving = scene.select(labels == MOVING)
    first = _drawn(session, moving, np.eye(4))
    before = np.median(frames_srgb[:2].astype(np.float32), axis=0)
    seen = ~hidden[:2].any(0)
    turned, shifted = np.zeros(2), np.zeros(2)
    for k in np.unique(np.linspace(2, len(frames_srgb) - 1, _DRAWINGS).astype(int)):
        observed = np.clip(frames_srgb[k] - before, -_CUT, _CUT)[seen & ~hidden[k]]
        T_carried = Ts_world_ee[k] @ np.linalg.inv(Ts_world_ee[0])
        T_shifted = np.eye(4)
        T_shifted[:3, 3] = Ts_world_ee[k, :3, 3] - Ts_world_ee[0, :3, 3]
        for sums, T in ((turned, T_carried), (shifted, T_shifted)):
            change = np.clip(_drawn(session, moving, T) - first, -_CUT, _CUT)[seen & ~hidden[k]]
            sums += [float((observed * change).sum()), float((change**2).sum())]
    answers = [_following(together, alone) for together, alone in (turned, shifted)]
    return max(answers, key=lambda answer: answer.share / max(answer.sd, 1e-9))


def _following(together: float, alone: float) -> FollowingEstimate:
    if not alone > 0:
        return FollowingEstimate(share=0.0, sd=float(np.inf))
    return FollowingEstimate(share=together / alone, sd=_NOISE * float(np.sqrt(_SHARED / alone)))


def _drawn(session: RenderSession, moving: Gaussians, T: Array) -> NDArray[np.float32]:
    """The scene (H, W, 3), 0..255, with the part moved by a transform."""
    parts = RigidParts(indices=np.zeros(len(moving), np.int32), Ts_world_part=T[None])
    return 255 * session.draw(moving, parts).rgb
