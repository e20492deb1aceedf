"""AOMotion: from one demonstration to when, where and how the part moved."""

from collections.abc import Callable

from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.errors import InputError
from aomgen.motion.answer import assemble
from aomgen.motion.demonstration import Demonstration
from aomgen.motion.film_answer import asked_film
from aomgen.motion.keyframe_view import KeyframeView
from aomgen.motion.params import MotionParams
from aomgen.motion.recovery import recover
from aomgen.physics.robot_masks import robot_masks


def _unheard(curve: MotionCurve) -> None:
    """Nobody wants the curve before the answer."""


def estimate_motion(
    demonstration: Demonstration,
    params: MotionParams | None = None,
    progress: Progress = silent,
    on_curve: Callable[[MotionCurve], None] = _unheard,
) -> MotionEstimate:
    """Recover the part's motion.

    Args:
        demonstration: Film, log and scan.
        params: Of the submodules.
        progress: Hears how far it is.
        on_curve: Hears the motion score as soon as it is known, before anything that it shows is refused.

    Raises:
        WrongPromptError: The hand moved something else than the prompted part.
        NoMotionError: The part does not move in the video.
        DemonstrationTooShortError, AmbiguousJointError: The motion does not tell the joint.
        InputError: A part has hardly any points.

    Source: AOMGen, sec. 4.2, AOMotion.
    """
    params = params or MotionParams()
    demo = demonstration
    for name, points in (("moving", demo.points_moving), ("static", demo.points_static)):
        if not len(points) >= 20:
            raise InputError(f"'{name}' part", f"has {len(points)} points, need 20", "correct its prompts")
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        progress(0.0, "keyframes")
        view = KeyframeView.of(demo, masks_at, params)
    seen, interval = view.interval(params.keyframes)
    curve = view.curve(seen, interval)
    on_curve(curve)
    signs = view.signs(demo, interval, params.keyframes)
    moved = view.moved_part(demo, params.keyframes)
    if moved.gripped or signs.log_odds > 0:
        moved.check()
    signs.check()
    progress(0.85, "joint")
    recovery = recover(demo, view, (interval.start.time_s, interval.end.time_s), params)
    progress(0.95, "joint values")
    answer = assemble(demo, curve, recovery, moved.odds)
    return asked_film(demo, answer, (recovery.estimate.axes, recovery.estimate.origins), params.photometric)
