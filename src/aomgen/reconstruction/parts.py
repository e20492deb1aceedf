"""Which part every Gaussian belongs to: robot, static part, moving part or background.

Source: AOMGen, sec. 4.1. The lifting is closed-form: a Gaussian takes the label whose masks it
paints most, over the views that were asked (as in FlashSplat, Shen et al., 2024). The robot needs
no segmenter: its masks are drawn from the aligned model.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected
from scipy.spatial import cKDTree

from aomgen.conventions import BACKGROUND, MOVING, ROBOT, STATIC
from aomgen.core.gaussians import Gaussians
from aomgen.core.progress import Progress
from aomgen.core.recording import Prompt
from aomgen.core.values import Array, freeze
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.binding import MAX_DISTANCE_M, nearest_links
from aomgen.reconstruction.enclosed import with_enclosed
from aomgen.reconstruction.outline_fit import RobotPosture
from aomgen.reconstruction.part_masks import PartMasks, ScanView, drawn_parts, lift, prompt_again
from aomgen.reconstruction.segmenter import PreparedImage, Segmenter

STAGE = "parts"
LOOSE_DISTANCE_M = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class PartsParams:
    """Effort and limits.

    Attributes:
        extra_views: Views asked again from geometry, beside the prompted ones.
        robot_views: Views whose drawn robot masks vote.
        voxel_m: Size of the grid on which pieces of a part must touch.
        min_gaussians: Fewest Gaussians of a usable part.
        seed: Of the samples on the robot's surface.
    """

    extra_views: int = 6
    robot_views: int = 20
    voxel_m: float = 0.02
    min_gaussians: int = 50
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Labels of N Gaussians.

    Attributes:
        labels: (N,), see `conventions.PART_LABELS`.
        confidence: (N,), share of the painted weight that agrees, 0 for unseen ones.
        robot_bodies: (N,), index into the robot's `body_names`, -1 where the label is not robot.
        views: Names of the scan images whose part masks were used.
    """

    labels: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    robot_bodies: NDArray[np.int32]
    views: tuple[str, ...]

    def __post_init__(self) -> None:
        count = len(self.labels)
        freeze(self, "labels", self.labels, (count,), np.uint8)
        freeze(self, "confidence", self.confidence, (count,), np.float32)
        freeze(self, "robot_bodies", self.robot_bodies, (count,), np.int32)


def find_parts(
    gaussians: Gaussians,
    views: list[ScanView],
    prompts: tuple[Prompt, ...],
    segmenter: Segmenter,
    posture: RobotPosture,
    progress: Progress,
    params: PartsParams | None = None,
) -> Parts:
    """Label all Gaussians.

    Args:
        gaussians: The scan, world frame.
        views: Scan images with drawn robot masks, world frame, held-out ones left out.
        prompts: Of the capture; boxes of "moving" and "static" are used.
        segmenter: Turns boxes into masks.
        posture: Robot as scanned.
        progress: Told about each view.
        params: See `PartsParams`.

    Raises:
        ReconstructionError: A part has no usable prompt, or almost nothing was found of it.
    """
    params = params or PartsParams()
    rng = np.random.default_rng(params.seed)
    bodies, robot_share = _robot(gaussians, views, posture, params, rng)
    progress(0.25, "robot labelled")
    by_name = {view.name: view for view in views}
    prepared: dict[str, PreparedImage] = {}
    labels = np.zeros(len(gaussians), np.uint8)
    for part, value in (("static", STATIC), ("moving", MOVING)):
        asked = [p for p in prompts if p.part == part and len(p.box) == 4 and p.image in by_name]
        if not asked:
            raise ReconstructionError(STAGE, f"no box prompts the {part} part", "add one to capture.toml")
        inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
        for prompt in asked:
            view = by_name[prompt.image]
            if view.name not in prepared:
                prepared[view.name] = segmenter.prepare(view.name, view.image_srgb)
            mask = prepared[view.name].mask(part, prompt.box, prompt.points) & ~view.robot
            weights = lift(gaussians, view, [mask, ~mask & ~view.robot])
            inside += weights[:, 0]
            seen += weights.sum(1)
        found = (inside > 0.6 * seen) & (inside > 0.05) & (bodies < 0)
        labels[_largest_piece(gaussians.means, found, inside, params.voxel_m)] = value
    progress(0.45, "prompts lifted")
    masks = _ask_views(gaussians, labels, views, prepared, segmenter, progress, params)
    labels, confidence = _vote(gaussians, labels, masks, bodies, params)
    robot = bodies >= 0
    labels[robot], confidence[robot] = ROBOT, robot_share[robot]
    labels = with_enclosed(gaussians.means, gaussians.opacities, labels)
    for part, value in (("static", STATIC), ("moving", MOVING)):
        count = int((labels == value).sum())
        if not count >= params.min_gaussians:
            raise ReconstructionError(
                STAGE,
                f"the {part} part has {count} Gaussians, want {params.min_gaussians}",
                "check its prompts",
            )
    progress(1.0, f"{len(masks)} views voted")
    return Parts(
        labels=labels,
        confidence=confidence,
        robot_bodies=np.where(labels == ROBOT, bodies, -1),
        views=tuple(sorted(item.view.name for item in masks)),
    )


def _robot(
    gaussians: Gaussians,
    views: list[ScanView],
    posture: RobotPosture,
    params: PartsParams,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int32], Array]:
    """Bodies (N,) of the robot's Gaussians and the share of their weight inside drawn masks."""
    means = np.asarray(gaussians.means, np.float64)
    near, distances = nearest_links(means, posture, rng, LOOSE_DISTANCE_M)
    inside, seen = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view in views[:: max(1, len(views) // params.robot_views)]:
        weights = lift(gaussians, view, [view.robot, ~view.robot])
        inside += weights[:, 0]
        seen += weights.sum(1)
    share = inside / np.maximum(seen, 1e-9)
    close = (share > 0.5) & (distances < MAX_DISTANCE_M)
    # A Gaussian on a thin finger paints well beyond the finger's outline.
    close |= (share > 0.25) & (distances < 0.5 * MAX_DISTANCE_M)
    # Rims that peep past the outline, and small Gaussians that nearly touch the model, are robot too.
    close |= (distances < 0.3 * MAX_DISTANCE_M) & (gaussians.scales.max(1) < MAX_DISTANCE_M)
    # Mirroring metal is reconstructed behind its surface: what all views see inside the robot is robot.
    behind = (share > 0.85) & (distances < LOOSE_DISTANCE_M)
    # What no view shows lies inside the robot when it is close to its surface.
    robot = (near >= 0) & np.where(seen > 0.05, close | behind, distances < 0.01)
    return np.where(robot, near, -1).astype(np.int32), share


def _ask_views(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    views: list[ScanView],
    prepared: dict[str, PreparedImage],
    segmenter: Segmenter,
    progress: Progress,
    params: PartsParams,
) -> list[PartMasks]:
    center = np.median(gaussians.means[labels > 0], 0)
    by_name = {view.name: view for view in views}
    masks = []
    order = list(prepared)
    directions = {view.name: _direction(view, center) for view in views}
    while len(order) - len(prepared) < params.extra_views:
        candidates = [view for view in views if view.name not in order]
        if not candidates:
            break
        taken = np.array([directions[name] for name in order])
        gaps = [np.linalg.norm(taken - directions[view.name], axis=1).min() for view in candidates]
        for index in np.argsort(gaps)[::-1]:
            if _shows_object(gaussians, labels, candidates[index]):
                order.append(candidates[index].name)
                break
        else:
            break
    for index, name in enumerate(order):
        view = by_name[name]
        image = prepared.get(name) or segmenter.prepare(name, view.image_srgb)
        answer = prompt_again(view, image, gaussians, labels)
        if answer is not None:
            masks.append(answer)
        progress(0.45 + 0.5 * (index + 1) / len(order), f"view {index + 1} of {len(order)}")
    if not masks:
        raise ReconstructionError(
            STAGE, "no view confirms the prompted parts", "check the boxes of the moving and the static part"
        )
    return masks


def _direction(view: ScanView, center: Array) -> Array:
    offset = view.camera.center - center
    return offset / np.linalg.norm(offset)


def _shows_object(gaussians: Gaussians, labels: NDArray[np.uint8], view: ScanView) -> bool:
    """Whether the object is large enough in a view and not much hidden by the robot or the border."""
    small = view.camera.resized(160, max(1, round(160 * view.camera.height / view.camera.width)))
    pixels, depths = small.project(gaussians.means[labels > 0][::5])
    inside = (depths > 0) & np.all((pixels > 2) & (pixels < [small.width - 2, small.height - 2]), 1)
    if not inside.mean() > 0.95:
        return False
    drawn = drawn_parts(gaussians, labels, small)
    return bool((drawn[STATIC] | drawn[MOVING]).mean() > 0.01)


def _vote(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    masks: list[PartMasks],
    bodies: NDArray[np.int32],
    params: PartsParams,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Labels and confidence from the masks of all answered views."""
    values = np.array([BACKGROUND, STATIC, MOVING], np.uint8)
    votes = np.zeros((len(gaussians), 3))
    for item in masks:
        rest = ~item.moving & ~item.static & ~item.view.robot
        votes += lift(gaussians, item.view, [rest, item.static, item.moving])
    seen = votes.sum(1)
    winner = values[np.argmax(votes, 1)]
    confidence = votes.max(1) / np.maximum(seen, 1e-9)
    known = (seen > 0.02) & (bodies < 0)
    winner[~known], confidence[~known] = BACKGROUND, 0.0
    winner = _fill_unseen(gaussians, winner, known, bodies, params)
    result = np.zeros(len(gaussians), np.uint8)
    for value, column in ((STATIC, 1), (MOVING, 2)):
        piece = _largest_piece(gaussians.means, winner == value, votes[:, column] + 1e-6, params.voxel_m)
        result[piece] = value
    return result, confidence.astype(np.float32)


def _fill_unseen(
    gaussians: Gaussians,
    labels: NDArray[np.uint8],
    known: NDArray[np.bool_],
    bodies: NDArray[np.int32],
    params: PartsParams,
) -> NDArray[np.uint8]:
    """Gaussians that no asked view shows take the label of their nearest neighbours."""
    unseen = np.flatnonzero(~known & (bodies < 0))
    if not len(unseen) or known.sum() < 8:
        return labels
    distances, nearest = cKDTree(gaussians.means[known]).query(gaussians.means[unseen], k=8)
    around = labels[known][nearest]
    counts = np.stack([(around == value).sum(1) for value in range(4)], 1)
    filled = labels.copy()
    filled[unseen] = np.where(
        np.median(distances, 1) < 1.5 * params.voxel_m, np.argmax(counts, 1), BACKGROUND
    )
    return filled


def _largest_piece(
    points: NDArray[np.float32], which: NDArray[np.bool_], weights: Array, voxel_m: float
) -> NDArray[np.bool_]:
    """The part of a selection (N,) that hangs together on a voxel grid, heaviest piece."""
    indices = np.flatnonzero(which)
    if not len(indices):
        return which
    low, high = np.quantile(points[indices], [0.005, 0.995], axis=0)
    inner = np.all((points[indices] >= low - 2 * voxel_m) & (points[indices] <= high + 2 * voxel_m), 1)
    indices = indices[inner]
    cells = np.floor((points[indices] - low) / voxel_m).astype(int) + 3
    shape = tuple(np.minimum(cells.max(0) + 2, 400))
    cells = np.minimum(cells, np.array(shape) - 1)
    grid = np.zeros(shape, bool)
    grid[tuple(cells.T)] = True
    pieces = np.zeros(shape, np.int32)
    connected(grid, np.ones((3, 3, 3)), output=pieces)
    mine = pieces[tuple(cells.T)]
    totals = np.bincount(mine, weights=weights[indices])
    result = np.zeros(len(which), bool)
    result[indices[mine == int(np.argmax(totals))]] = True
    return result
