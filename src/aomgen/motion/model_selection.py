"""What the video says about the type of a joint: which of two refined answers it looks like."""

import numpy as np

from aomgen.motion.photometric import MIN_EXPLAINED, MIN_FRAMES, PhotometricFrames, PhotometricParams
from aomgen.motion.photometric_residuals import JointMotion, compare_frames


def compute_type_margin(
    seen: PhotometricFrames | None,
    answers: tuple[JointMotion, JointMotion],
    params: PhotometricParams | None = None,
) -> float:
    """Twice the log evidence of the video for one answer over another; 0 where it cannot tell.

    Frames that no answer was fitted to are compared square by square of the part's painted surface.

    Args:
        seen: The video as read for the first answer's type.
        answers: The first and the second one, each refined on the video.
        params: How the video is compared.

    Not checked: that the residuals of different frames are independent of each other.
    """
    if seen is None:
        return 0.0
    params = params or PhotometricParams()
    first, second = answers
    frames = compare_frames(seen.renderer, seen.held_out, second, first, params.bands[-1])
    if len(frames) < MIN_FRAMES:
        return 0.0
    margin = sum(item.margin for item in frames)
    better = [item.explained_after if margin > 0 else item.explained_before for item in frames]
    return margin if float(np.median(better)) >= MIN_EXPLAINED else 0.0
