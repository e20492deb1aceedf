"""AOMotion: from one demonstration to when, where and how the part moved."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from aomgen.core.motion import MotionCurve, MotionEstimate
from aomgen.core.progress import Progress, silent
from aomgen.errors import InputError
from aomgen.motion.answer import assemble
from aomgen.motion.inputs import MotionInput
from aomgen.motion.joint_estimation import JointCandidates, choose_type
from aomgen.motion.joint_trajectory import RecoveredMotion, prepare_recovery, recover_motion
from aomgen.motion.model_selection import compute_type_margin
from aomgen.motion.observations import VideoObservations
from aomgen.motion.params import MotionParams
from aomgen.motion.photometric import PhotometricFrames, select_frames
from aomgen.motion.photometric_estimate import make_kinematic_prior, refine_estimate
from aomgen.motion.photometric_residuals import JointMotion as FilmAnswer
from aomgen.robots.robot_masks import MasksAt, robot_masks


def _unheard(curve: MotionCurve) -> None:
    """Nobody wants the curve before the answer."""


def estimate_motion(
    demonstration: MotionInput,
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
        view = VideoObservations.of(demo, masks_at, params)
        seen, interval = view.interval()
        curve = view.curve(seen, interval)
        on_curve(curve)
        signs = view.signs(demo, interval)
        moved = view.identify_part(demo)
        if moved.gripped or signs.log_odds > 0:
            moved.check()
        signs.check()
        progress(0.4, "joint")
        first = prepare_recovery(demo, view, seen, interval, params)
        doors, drawers = (
            _answer(demo, masks_at, curve, moved.odds, recover_motion(first, joint_type, params), params)
            for joint_type in ("revolute", "prismatic")
        )
    progress(0.9, "type of the joint")
    film = compute_type_margin(doors.seen, (doors.as_filmed, drawers.as_filmed), params.photometric)
    found = min((doors.found, drawers.found), key=lambda item: abs(item.margin))
    answer = doors if choose_type(found, film) == "revolute" else drawers
    return replace(answer.refined, type_margin=abs(found.margin + film))


def first_motion(demo: MotionInput, params: MotionParams | None = None) -> MotionEstimate:
    """The motion by the hand's path alone, not refined on the film, and nothing of it judged.

    It tells which Gaussians move, also where labels are too poor for `estimate_motion`.

    Raises: as `estimate_motion`.
    """
    params = params or MotionParams()
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        view = VideoObservations.of(demo, masks_at, params)
        seen, interval = view.interval()
        first = prepare_recovery(demo, view, seen, interval, params)
    joint_type = "revolute" if first.found.margin > 0 else "prismatic"
    return assemble(demo, view.curve(seen, interval), recover_motion(first, joint_type, params), odds=1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Answer:
    """The answer if the joint is of a type: by the hand's path, the film as read for it, and refined on it."""

    found: JointCandidates
    seen: PhotometricFrames | None
    refined: MotionEstimate

    @property
    def as_filmed(self) -> FilmAnswer:
        """What the film is compared with."""
        return self.refined.joint, self.refined.thetas


def _answer(
    demo: MotionInput,
    masks_at: MasksAt,
    curve: MotionCurve,
    odds: float,
    recovery: RecoveredMotion,
    params: MotionParams,
) -> _Answer:
    lines = (recovery.estimate.axes, recovery.estimate.origins)
    estimate = assemble(demo, curve, recovery, odds)
    hand = make_kinematic_prior(demo, estimate, lines)
    seen = select_frames(demo, masks_at, hand, params.photometric)
    refined = refine_estimate(seen, estimate, hand, params.photometric)
    return _Answer(found=recovery.found, seen=seen, refined=refined)
