"""Alignment of the structure with the robot: the similarity `S_world_recon`.

Hypotheses come from the prompted boxes and a coarse color score (`pose_search`). Each is fitted to the contours in the scan
images (`contours`), the best is refined on all views, and ambiguous estimates are refused. Source: AOMGen, sec. 4.1, "Scene and
robot alignment"; the paper's rigid ICP needs a known scale and clean robot points, so outlines in the images take its place.
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.alignment.confidence import (
    Confirmation,
    ViewEvidence,
    collect_evidence,
    confirmation,
    find_wrist_rotation,
)
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.pose_search import Scan, search_poses
from aomgen.alignment.silhouette_fit import (
    FINE,
    MIDDLE,
    RobotDrawing,
    limit_width,
    refine,
    robot_drawing,
    spread,
)
from aomgen.alignment.uncertainty import (
    SIGNIFICANT_SDS,
    CameraErrors,
    covariance_from_cameras,
    joint_offset_limits,
    joint_offsets,
    message_unit,
    similarity_covariance,
)
from aomgen.core.alignment import Alignment
from aomgen.core.progress import Progress, part
from aomgen.core.transforms import apply, similarity
from aomgen.core.values import Array
from aomgen.errors import AlignmentError
from aomgen.robots.robot import RobotConfiguration, RobotModel

STAGE = "alignment"
# Least support beyond chance of the whole robot, 0..1; displaced contours reach 0 by definition.
MIN_LIFT = 0.2
# Least support of every segment of the arm that a joint moves: half, because a segment has few contour points.
MIN_SEGMENT_LIFT = MIN_LIFT / 2
# Least difference in support to another hypothesis: half of the least support.
MIN_MARGIN = MIN_LIFT / 2
# Hypotheses with at least this share of the best color score are fitted to contours, because color ranks only coarsely.
FINALIST_SHARE = 0.5
# Distance from which on two hypotheses are different, [m]: much larger than the search range of the contour fit.
DISTINCT_M = 0.05
# Least motion of the contour by a significant offset, [px]: the error of an image edge.
MIN_JOINT_MOVE_PX = 0.5
# Largest width of the images, [px]: sufficient for the accuracy of the sparse structure.
WIDTH = 640
# Largest standard deviation of the end effector, [m]: a larger one does not determine the grasp of a handle.
MAX_SD_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentParams:
    """Effort and limits of the alignment.

    Attributes:
        start_poses: Numbers of poses in the first pass of the search, tried in turn until a hypothesis is confirmed.
        search_views, search_width: Number of the images for the search, and their width, [px].
        views: Number of scan images, spread over the walk.
        contour_points: Number of outline points of a view.
    """

    start_poses: tuple[int, ...] = (2400, 7200)
    search_views: int = 8
    search_width: int = 80
    views: int = 24
    contour_points: int = 400


def align(
    scan: Scan,
    configuration: RobotConfiguration,
    progress: Progress,
    rng: np.random.Generator,
    params: AlignmentParams | None = None,
) -> Alignment:
    """Find `S_world_recon` from the robot's contours in the scan images.

    Args:
        scan: Images that show the robot in `configuration`, with at least one prompted box.
        configuration: Robot and its joint values during the scan.

    Raises:
        AlignmentError: No box, the outlines are not confirmed by the images, or two different
            hypotheses are confirmed equally well.

    Not checked: intrinsics are taken as given, and the robot's base must stand within about 30
    degrees of upright.
    """
    params = params or AlignmentParams()
    if not scan.boxes:
        raise AlignmentError(
            STAGE, "no prompt gives a box around the robot", "add a robot box to capture.toml"
        )
    cameras = [view.camera_recon for view in scan.views]
    S_unit_recon = unit_frame([camera.center for camera in cameras], cameras[0].T_world_cam)
    scan = scan.view_from(S_unit_recon)
    scan = replace(scan, views=[limit_width(view, WIDTH) for view in scan.views])
    width = max(view.camera_recon.width for view in scan.views)
    height = max(view.camera_recon.height for view in scan.views)
    with robot_drawing(configuration, width, height) as drawing:
        S, runner_up = _likeliest(scan, drawing, part(progress, 0.0, 0.6), rng, params)
        chosen = spread(scan.views, S, drawing, params.views)
        S = refine(S, chosen, drawing, FINE, params.contour_points)
        progress(0.9, "refined on all views")
        evidence = collect_evidence(S, chosen, drawing, params.contour_points)
        confirmed = confirmation(evidence)
        _refuse_unconfirmed(confirmed, runner_up, configuration)
        rotation = find_wrist_rotation(S, chosen[::2], drawing, params.contour_points, evidence)
        if rotation is not None:
            turn_rad, gain = rotation
            measured = f"they confirm {gain:.0%} more of the gripper there"
            raise _make_joint_error(configuration.robot, -1, turn_rad, measured)
    _refuse_wrong_joints(evidence, configuration)
    residuals = {view.name: np.abs(view.edge_px[view.confirmed]) for view in evidence}
    result = Alignment(
        S_world_recon=S @ S_unit_recon,
        support=confirmed.support,
        chance=confirmed.chance,
        runner_up_support=runner_up,
        residual_px=float(np.median(np.concatenate([*residuals.values()]))),
        residual_px_of_view={
            name: float(np.median(own)) for name, own in residuals.items() if len(own) >= 10
        },
        ee_sd_m=_ee_sd_m(evidence, scan.errors and scan.errors.view_from(S)),
    )
    if not result.ee_sd_m <= MAX_SD_M:
        raise AlignmentError(
            STAGE,
            f"the position of the end effector has an uncertainty of {1000 * result.ee_sd_m:.1f} mm, limit "
            f"{1000 * MAX_SD_M:.0f} mm",
            "scan the robot from more sides",
        )
    progress(1.0, f"support {result.support:.2f}, end effector +-{1000 * result.ee_sd_m:.1f} mm")
    return result


def _likeliest(
    scan: Scan, drawing: RobotDrawing, progress: Progress, rng: np.random.Generator, params: AlignmentParams
) -> tuple[Array, float]:
    """Find the best hypothesis on coarse images, and the support of the best different one; 0 without one.

    Raises:
        AlignmentError: The images confirm no hypothesis.
    """
    best: list[tuple[Confirmation, Array]] = []
    for number, guesses in enumerate(params.start_poses):
        starts, scores = search_poses(
            scan,
            drawing.configuration,
            rng,
            guesses=guesses,
            view_count=params.search_views,
            width=params.search_width,
        )
        starts = starts[scores >= FINALIST_SHARE * scores.max()]
        now = part(progress, number / len(params.start_poses), (number + 1) / len(params.start_poses))
        now(0.5, "searched for likely poses")
        ranked = _refine_starts(starts, scan.views, drawing, part(now, 0.5, 1.0))
        best = max(best, ranked, key=lambda poses: poses[0][0].lift if poses else -1.0)
        if best and best[0][0].lift >= MIN_LIFT:
            break
    if not best:
        raise AlignmentError(
            STAGE, "no initial pose places the robot in the images", "check the robot prompts"
        )
    first, S = best[0]
    if not first.lift >= MIN_LIFT / 2:
        raise _make_confidence_error(first)
    others = [other.support for other, T in best[1:] if _distance(S, T, drawing.configuration) > DISTINCT_M]
    return S, max(others, default=0.0)


def _ee_sd_m(evidence: list[ViewEvidence], errors: CameraErrors | None) -> float:
    """Compute the standard deviation of the end effector, [m]; `errors` are those of the cameras in the world frame."""
    covariance = similarity_covariance(evidence)
    if errors is not None:
        covariance = covariance + covariance_from_cameras(evidence, errors)
    return float(np.sqrt(np.trace(covariance[3:6, 3:6])))


def unit_frame(centers_recon: list[Array], T_recon_cam: Array) -> Array:
    """Compute a similarity (4, 4) to a frame that does not depend on the scale and axes of `recon`.

    Args:
        centers_recon: Camera centres; they have mean zero and unit spread afterwards.
        T_recon_cam: A camera whose axes the new frame takes.
    """
    centers = np.array(centers_recon)
    middle = centers.mean(0)
    size = float(np.sqrt(np.mean(np.sum((centers - middle) ** 2, axis=1)))) or 1.0
    R = T_recon_cam[:3, :3].T
    return similarity(1 / size, R, -R @ middle / size)


def _refine_starts(
    starts: Array, views: list[AlignmentImage], drawing: RobotDrawing, progress: Progress
) -> list[tuple[Confirmation, Array]]:
    """Fit every start (H, 4, 4) to the contours of some views; best support first."""
    ranked = []
    for index, start in enumerate(starts):
        chosen = spread(views, start, drawing, 8)
        if chosen:
            S = refine(start, chosen, drawing, MIDDLE, 200)
            ranked.append((confirmation(collect_evidence(S, chosen, drawing, 200)), S))
        progress((index + 1) / len(starts), f"pose {index + 1} of {len(starts)}")
    return sorted(ranked, key=lambda item: -item[0].support)


def _make_confidence_error(found: Confirmation) -> AlignmentError:
    return AlignmentError(
        STAGE,
        f"the images confirm {found.support:.0%} of the robot's outline, and {found.chance:.0%} of an outline at "
        f"a random pose; the difference must be at least {MIN_LIFT:.0%}",
        "check the robot prompts and that the first rows of the log are the scan's joint values",
    )


def _refuse_unconfirmed(found: Confirmation, runner_up: float, configuration: RobotConfiguration) -> None:
    if not found.lift >= MIN_LIFT:
        raise _make_confidence_error(found)
    if not found.support - runner_up >= MIN_MARGIN:
        raise AlignmentError(
            STAGE,
            f"two poses of the robot are confirmed equally well ({found.support:.0%} and {runner_up:.0%})",
            "add a robot box on an image from another side",
        )
    # The base is excluded: it may be occluded or on a mount, and does not depend on the joints.
    for segment, lift in sorted(found.lift_of_segment.items()):
        if segment > 0 and not lift >= MIN_SEGMENT_LIFT:
            joint = configuration.robot.joint_names[segment - 1]
            raise AlignmentError(
                STAGE,
                f"from {joint} to the gripper, the robot in the images is not where its joint values place it: image "
                f"edges confirm {lift:.0%} of this outline more than by chance, at least {MIN_SEGMENT_LIFT:.0%} are needed",
                "check scan_state: the joint values must be those during the scan",
            )


def _refuse_wrong_joints(evidence: list[ViewEvidence], configuration: RobotConfiguration) -> None:
    robot = configuration.robot
    offsets, sds, moves_px = joint_offsets(evidence, robot.slides)
    sizes, limits = np.abs(offsets), joint_offset_limits(robot.slides)
    wrong = (sizes > limits) & (sizes > SIGNIFICANT_SDS * sds) & (moves_px > MIN_JOINT_MOVE_PX)
    if wrong.any():
        worst = int(np.argmax(np.where(wrong, sizes / limits, 0)))
        factor, _ = message_unit(robot.slides[worst])
        measured = f"+-{factor * sds[worst]:.1f}, limit {factor * limits[worst]:.0f}"
        raise _make_joint_error(robot, worst, offsets[worst], measured)


def _make_joint_error(robot: RobotModel, joint: int, offset: float, measured: str) -> AlignmentError:
    factor, unit = message_unit(robot.slides[joint])
    return AlignmentError(
        STAGE,
        f"{robot.joint_names[joint]} is {factor * offset:+.0f} {unit} from its logged value in the images ({measured})",
        "check scan_state: the joint values must be those during the scan",
    )


def _distance(S_a: Array, S_b: Array, configuration: RobotConfiguration) -> float:
    """Compute the mean distance [m] between the robot's surface under two similarities."""
    points = configuration.points_world(200)
    moved = apply(S_a @ np.linalg.inv(S_b), points)
    return float(np.linalg.norm(moved - points, axis=1).mean())
