"""What the film says about the type of a joint: which of two refined answers it looks like."""

from typing import Final

import numpy as np

from aomgen.motion.demonstration import Demonstration
from aomgen.motion.film_fit import Answer, compared
from aomgen.motion.hand_answer import HandAnswer
from aomgen.motion.part_film import part_film
from aomgen.motion.photometric import PhotometricParams, chosen_frames
from aomgen.physics.robot_masks import MasksAt

# Fewer frames that show the part tell nothing.
MIN_FRAMES: Final = 3


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
    seen = compared(film, held_out, second, first, params.bands[-1])
    if len(seen) < MIN_FRAMES:
        return 0.0
    margin = sum(item.margin for item in seen)
    better = [item.explained_after if margin > 0 else item.explained_before for item in seen]
    return margin if float(np.median(better)) >= params.min_explained else 0.0
