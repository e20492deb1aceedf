"""What the film says about the type of a joint: which of two refined answers it looks like."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.joint import Joint
from aomgen.core.values import Array
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.film_fit import Band, compared
from aomgen.motion.hand_answer import HandAnswer
from aomgen.motion.part_film import PartFilm, part_film
from aomgen.motion.photometric import PhotometricParams, chosen_frames
from aomgen.physics.robot_masks import MasksAt

# Fewer frames that show the part tell nothing.
MIN_FRAMES: Final = 3
# A joint, and its values at the video's frames (T,).
Answer = tuple[Joint, Array]


def film_margin(
    demo: Demonstration,
    masks_at: MasksAt,
    hand: HandAnswer,
    answers: tuple[Answer, Answer],
    params: PhotometricParams | None = None,
) -> float:
    """Twice the log evidence of the film for one answer over another; 0 where it cannot tell.

    Frames that no answer was fitted to are compared square by square of the part's painted surface.

    Args:
        demo: Film, camera and the scene as scanned.
        masks_at: Draws the robot.
        hand: The hand's answer of the first one's type, which names the frames.
        answers: The first and the second one, each refined on the film.
        params: How the film is compared.

    Not checked: that the residuals of different frames are independent of each other.
    """
    params = params or PhotometricParams()
    first, second = answers
    fitted, held_out, resting = chosen_frames(hand, params.knots)
    if len(fitted) < MIN_FRAMES or len(resting) < 2:
        return 0.0
    moments = (resting, np.concatenate([fitted, held_out]), float(hand.thetas.max()))
    film = part_film(
        demo, masks_at, hand.joint, moments, max_pixels=params.max_pixels, dilate_px=params.dilate_px
    )
    band = params.bands[-1]
    margin, explained = _margin(film, held_out, (second, first), band)
    if margin < 0:
        margin, explained = _margin(film, held_out, (first, second), band)
        margin = -margin
    return margin if explained >= params.min_explained else 0.0


def _margin(
    film: PartFilm, frames: NDArray[np.intp], answers: tuple[Answer, Answer], band: Band
) -> tuple[float, float]:
    """Evidence of the second answer over the first, and the share of the film's detail that it explains."""
    (before, thetas_before), (after, thetas_after) = answers
    found = [
        compared(film, int(k), ((before, float(thetas_before[k])), (after, float(thetas_after[k]))), band)
        for k in frames
    ]
    seen = [item for item in found if item is not None]
    if len(seen) < MIN_FRAMES:
        return 0.0, 0.0
    return sum(item.margin for item in seen), float(np.median([item.explained for item in seen]))
