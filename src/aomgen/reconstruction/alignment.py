"""The similarity that brings the structure's frame into the robot's: `S_world_recon`.

Coarse starts come from the prompted boxes (`alignment_start`); each is pulled onto the outlines
that the scan images show (`contours`), the best is refined on all views, and doubtful answers
are refused. Source: AOMGen, sec. 4.1, "Scene and robot alignment"; the paper's rigid ICP needs a
known scale and clean robot points, so outlines in the images take its place.
"""

from dataclasses import dataclass, replace

import numpy as np

from aomgen.core.progress import Progress, part
from aomgen.core.transforms import apply
from aomgen.core.values import Array, freeze
from aomgen.errors import AlignmentError
from aomgen.physics.silhouette import SilhouetteRenderer
from aomgen.reconstruction.alignment_start import RobotBox, Start, sweep_yaw, up_candidates
from aomgen.reconstruction.contours import View, color_ratio, edge_shifts, region_shifts, shift_jacobian
from aomgen.reconstruction.outline_fit import (
    COARSE,
    FINE,
    MIDDLE,
    RobotDrawing,
    RobotPosture,
    camera_in_world,
    gray_levels,
    reduced,
    refine,
    spread,
)

STAGE = "alignment"


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentParams:
    """Effort and limits.

    Attributes:
        starts: Coarse hypotheses that are tried.
        finalists: The best of them, which are refined further and compared.
        views: Scan images used, spread over the walk.
        width: Images wider than this are reduced, [px].
        contour_points: Outline points a view.
        min_support: Least share of outline points that the images confirm.
        min_margin: Least lead in support over a different hypothesis.
        distinct_m: Hypotheses whose end effectors are closer than this are the same.
        max_sd_m: Largest standard deviation of the end effector.
    """

    starts: int = 8
    finalists: int = 3
    views: int = 24
    width: int = 640
    contour_points: int = 400
    min_support: float = 0.3
    min_margin: float = 0.1
    distinct_m: float = 0.05
    max_sd_m: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The answer and how far it can be trusted.

    Attributes:
        S_world_recon: Similarity (4, 4), metres per recon unit included.
        support: Share of outline points, over all views, that the images confirm within 2 px.
        runner_up_support: The same for the best different hypothesis, 0 when there was none.
        residual_px: Median distance of confirmed outline points from image edges.
        residual_px_of_view: The same for each view that shows enough robot.
        ee_sd_m: Standard deviation of the end effector, from the scatter of the residuals.
    """

    S_world_recon: Array
    support: float
    runner_up_support: float
    residual_px: float
    residual_px_of_view: dict[str, float]
    ee_sd_m: float

    def __post_init__(self) -> None:
        freeze(self, "S_world_recon", self.S_world_recon, (4, 4))


def align(
    views: list[View],
    boxes: list[RobotBox],
    points_recon: Array,
    posture: RobotPosture,
    progress: Progress,
    rng: np.random.Generator,
    params: AlignmentParams | None = None,
) -> Alignment:
    """Find `S_world_recon` from the robot's outlines in the scan images.

    Args:
        views: Images that show the robot in `posture` (scan, first frames of fixed cameras).
        boxes: Prompted boxes around the robot, at least one; two far apart are better.
        points_recon: Sparse points (P, 3), for the up direction only.
        posture: Robot and its joint values during the scan.
        progress: Told after each hypothesis.
        rng: Random choices of the plane search.
        params: See `AlignmentParams`.

    Raises:
        AlignmentError: No box, the outlines are not confirmed by the images, or two different
            hypotheses are confirmed equally well.

    Not checked: camera poses and intrinsics are taken as given, and the robot's base must stand
    within about 30 degrees of upright.
    """
    params = params or AlignmentParams()
    if not boxes:
        raise AlignmentError(
            STAGE, "no prompt gives a box around the robot", "add a robot box to capture.toml"
        )
    views = [reduced(view, params.width) for view in views]
    ups = up_candidates([view.camera_recon for view in views], points_recon, rng)
    starts = [start for up in ups for start in sweep_yaw(boxes, posture.points_world(), up)]
    starts = _different(sorted(starts, key=lambda start: start.misfit), posture, params)
    width = max(view.camera_recon.width for view in views)
    height = max(view.camera_recon.height for view in views)
    with SilhouetteRenderer(posture.robot, max_width=width, max_height=height) as renderer:
        drawing = RobotDrawing(renderer=renderer, posture=posture)
        ranked = _refine_starts(starts, views, drawing, part(progress, 0.05, 0.7), params)
        S = ranked[0][1]
        others = [s for s, other in ranked[1:] if _distance(S, other, posture) > params.distinct_m]
        chosen = spread(views, S, drawing, params.views)
        S = refine(S, chosen, drawing, FINE, params.contour_points)
        progress(0.9, "refined on all views")
        result = _judge(S, chosen, drawing, max(others, default=0.0), params)
    _refuse_doubt(result, params)
    progress(1.0, f"support {result.support:.2f}, end effector +-{1000 * result.ee_sd_m:.1f} mm")
    return result


def _refine_starts(
    starts: list[Start], views: list[View], drawing: RobotDrawing, progress: Progress, params: AlignmentParams
) -> list[tuple[float, Array]]:
    """Pull every start onto coarse images, the best of them onto finer ones; best support first."""
    few = replace(params, contour_points=200)
    coarse, ranked = [], []
    for index, start in enumerate(starts):
        chosen = [reduced(view, 160) for view in spread(views, start.S_world_recon, drawing, 6)]
        if chosen:
            S = refine(start.S_world_recon, chosen, drawing, COARSE, 200)
            coarse.append((_judge(S, chosen, drawing, 0.0, few).support, S))
        progress(0.7 * (index + 1) / len(starts), f"start {index + 1} of {len(starts)}")
    for _, start in sorted(coarse, key=lambda item: -item[0])[: params.finalists]:
        S = refine(start, spread(views, start, drawing, 10), drawing, MIDDLE, 200)
        judged = _judge(S, spread(views, S, drawing, 10), drawing, 0.0, few)
        ranked.append((judged.support, S))
    progress(1.0, f"{len(ranked)} finalists")
    if not ranked:
        raise AlignmentError(STAGE, "no start puts the robot into the images", "check the robot prompts")
    return sorted(ranked, key=lambda item: -item[0])


def _judge(
    S: Array, views: list[View], drawing: RobotDrawing, runner_up: float, params: AlignmentParams
) -> Alignment:
    """Ask every view how many outline points have an image edge within 2 px of 8."""
    confirmed, total = 0, 0
    of_view: dict[str, float] = {}
    residuals = []
    A = np.zeros((7, 7))
    posture = drawing.posture
    for view in views:
        camera = camera_in_world(S, view.camera_recon)
        drawn = drawing.contour(camera, params.contour_points)
        if drawn is None:
            continue
        contour, mask = drawn
        edge, strength = edge_shifts(contour, gray_levels(view.image_srgb), 8)
        region, _ = region_shifts(contour, color_ratio(view.image_srgb, mask, 16), 8)
        good = (np.abs(edge) <= 2) & (strength > 0.02) & (np.abs(region) <= 3)
        confirmed += int(good.sum())
        total += len(good)
        if good.sum() >= 10:
            of_view[view.name] = float(np.median(np.abs(edge[good])))
            residuals.append(edge[good])
            J = shift_jacobian(camera, contour, posture.ee_world)[good]
            # Neighbouring outline points err together: ten of them count as one.
            A += J.T @ J / 10
    if not residuals:
        return Alignment(
            S_world_recon=S, support=0.0, runner_up_support=runner_up, residual_px=np.inf,
            residual_px_of_view={}, ee_sd_m=np.inf,
        )  # fmt: skip
    pooled = np.concatenate(residuals)
    covariance = np.linalg.pinv(A) * np.mean(pooled**2)
    return Alignment(
        S_world_recon=S,
        support=confirmed / total,
        runner_up_support=runner_up,
        residual_px=float(np.median(np.abs(pooled))),
        residual_px_of_view=of_view,
        ee_sd_m=float(np.sqrt(np.trace(covariance[3:6, 3:6]))),
    )


def _refuse_doubt(result: Alignment, params: AlignmentParams) -> None:
    if not result.support >= params.min_support:
        raise AlignmentError(
            STAGE,
            f"the images confirm {result.support:.0%} of the robot's outline, want {params.min_support:.0%}",
            "check the robot prompts and that the first rows of the log are the scan's joint values",
        )
    if not result.support - result.runner_up_support >= params.min_margin:
        raise AlignmentError(
            STAGE,
            f"two places of the robot are confirmed alike ({result.support:.0%} and "
            f"{result.runner_up_support:.0%})",
            "add a robot box on an image from another side",
        )
    if not result.ee_sd_m <= params.max_sd_m:
        raise AlignmentError(
            STAGE,
            f"the end effector is known to {1000 * result.ee_sd_m:.1f} mm, want {1000 * params.max_sd_m:.0f} mm",
            "scan the robot from more sides",
        )


def _different(starts: list[Start], posture: RobotPosture, params: AlignmentParams) -> list[Start]:
    kept: list[Start] = []
    for start in starts:
        if len(kept) < params.starts and all(
            _distance(start.S_world_recon, other.S_world_recon, posture) > params.distinct_m for other in kept
        ):
            kept.append(start)
    return kept


def _distance(S_a: Array, S_b: Array, posture: RobotPosture) -> float:
    """Mean distance [m] between the robot placed by one similarity and by another."""
    points = posture.points_world(200)
    moved = apply(S_a @ np.linalg.inv(S_b), points)
    return float(np.linalg.norm(moved - points, axis=1).mean())
