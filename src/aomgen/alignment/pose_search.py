"""Search for the pose of the robot: many poses that agree with the prompted boxes, the best improved further.

Boxes leave heading and depth open and are drawn by hand, so a thousand poses are scored in small
images (`color_score`). The best of them, kept apart from one another, are perturbed in ever smaller
steps. Source: a plain evolution strategy, Beyer and Schwefel,
2002, with niches.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from aomgen.alignment.color_score import color_score
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.silhouette_fit import far_apart, limit_width
from aomgen.alignment.starting_poses import PoseCandidates, RobotBox, find_starting_poses, up_candidates
from aomgen.alignment.uncertainty import CameraErrors
from aomgen.core.camera import camera_in_world
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.core.values import Array, freeze_arrays
from aomgen.robots.robot import RobotConfiguration


@dataclass(frozen=True, slots=True, kw_only=True)
class Generation:
    """One round of the evolution strategy.

    Attributes:
        parents: Poses kept.
        apart: They differ by more than this, as a share of the robot's size.
        children: New poses near each.
        step: Standard deviation of their distance along each axis, same share.
    """

    parents: int
    apart: float
    children: int
    step: float


# Poses that fit the prompted boxes worse than the best by this share of a box are dropped; boxes are drawn
# by hand.
MAX_MISFIT = 0.15
# Width of the images for the first pass over all poses, [px]: links are a few pixels wide, and it is quick.
FIRST_WIDTH = 48
# Rounds; steps begin at the size of the basin of attraction, about the thickness of a link.
GENERATIONS = (
    Generation(parents=50, apart=0.08, children=6, step=0.06),
    Generation(parents=24, apart=0.06, children=8, step=0.04),
    Generation(parents=12, apart=0.05, children=10, step=0.025),
    Generation(parents=6, apart=0.03, children=12, step=0.012),
)
# Number of poses returned at most: the best and its rivals.
KEPT = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchParams:
    """Effort.

    Attributes:
        guesses: Poses scored first.
        width, first_width: Of the small images, and of those for the first pass, [px].
        views: How many of them.
        apart: The poses returned differ by more than this share of the robot's size.
    """

    guesses: int = 2400
    width: int = 80
    views: int = 8
    apart: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Input of the alignment, from structure and prompts.

    Attributes:
        views: Images that show the robot as it stood during the scan.
        boxes: Prompted boxes around the robot; two far apart are better than one.
        points_recon: Sparse points (P, 3).
        errors: How far the cameras may be off; without, they are taken as exact.
    """

    views: list[AlignmentImage]
    boxes: list[RobotBox]
    points_recon: Annotated[Array, "_ 3"]
    errors: CameraErrors | None = None

    __post_init__ = freeze_arrays

    def seen_from(self, S_other_recon: Array) -> "Scan":
        """The same in another frame."""
        return Scan(
            views=[
                replace(view, camera_recon=camera_in_world(S_other_recon, view.camera_recon))
                for view in self.views
            ],
            boxes=[
                replace(box, camera_recon=camera_in_world(S_other_recon, box.camera_recon))
                for box in self.boxes
            ],
            points_recon=apply(S_other_recon, self.points_recon),
            errors=self.errors and self.errors.seen_from(S_other_recon),
        )


def search_poses(
    scan: Scan,
    configuration: RobotConfiguration,
    rng: np.random.Generator,
    params: SearchParams | None = None,
) -> PoseCandidates:
    """Find likely poses of the robot, best first and far from one another.

    Args:
        scan: Images with cameras, one prompted box or more.
        configuration: The robot during the scan.
        rng: Makes guesses and children.
        params: Effort.
    """
    params = params or SearchParams()
    vertices = configuration.points_world()
    probe = vertices[rng.choice(len(vertices), 16, replace=False)]
    ups = up_candidates([view.camera_recon for view in scan.views], scan.points_recon, rng)
    places = find_starting_poses(scan.boxes, vertices, ups, scan.points_recon, rng, params.guesses)
    Ss = places.Ss_world_recon[places.scores >= places.scores.max() - MAX_MISFIT]
    Ss_recon_world = np.asarray(np.linalg.inv(Ss[:200]), np.float64)
    chosen = _views_on(scan.views, apply(Ss_recon_world, probe.mean(0)), params.views)
    first = color_score([limit_width(view, FIRST_WIDTH) for view in chosen], configuration, rng)
    score = color_score([limit_width(view, params.width) for view in chosen], configuration, rng)
    begin = GENERATIONS[0]
    found = PoseCandidates(Ss_world_recon=Ss, scores=first(Ss))
    found = select_distinct(found, probe, begin.apart, begin.parents)
    found = replace(found, scores=score(found.Ss_world_recon))
    for generation in GENERATIONS:
        parents = select_distinct(found, probe, generation.apart, generation.parents)
        children = _near(parents.Ss_world_recon, probe, generation, rng)
        found = PoseCandidates(
            Ss_world_recon=np.concatenate([found.Ss_world_recon, children]),
            scores=np.concatenate([found.scores, score(children)]),
        )
    return select_distinct(found, probe, params.apart, KEPT)


def select_distinct(found: PoseCandidates, points_world: Array, apart: float, count: int) -> PoseCandidates:
    """Select the best poses, at most `count`, no two nearer than a share of the robot's size."""
    Ss = found.Ss_world_recon
    placed = _transform_points(np.asarray(np.linalg.inv(Ss), np.float64), points_world)
    sizes = np.linalg.norm(placed - placed.mean(1, keepdims=True), axis=2).mean(1)
    left = np.argsort(-found.scores, kind="stable")
    kept = []
    while len(left) and len(kept) < count:
        best, left = left[0], left[1:]
        kept.append(best)
        distances = np.linalg.norm(placed[left] - placed[best], axis=2).mean(1)
        left = left[distances > apart * np.sqrt(sizes[left] * sizes[best])]
    return PoseCandidates(Ss_world_recon=Ss[kept], scores=found.scores[kept])


def _near(Ss: Array, points_world: Array, generation: Generation, rng: np.random.Generator) -> Array:
    """Children (C, 4, 4): the robot turned, moved and scaled a little about its middle."""
    middle = points_world.mean(0)
    size = np.linalg.norm(points_world - middle, axis=1).mean()
    count = len(Ss) * generation.children
    turns = matrix_from_rotvec(rng.normal(0, generation.step, (count, 3)) * [0.5, 0.5, 1.0])
    factors = np.exp(rng.normal(0, generation.step, (count, 1, 1)))
    moves = rng.normal(0, generation.step * size, (count, 3))
    turned = factors * turns
    Ds = transform(turned, middle + moves - turned @ middle)
    return np.asarray(np.linalg.inv(Ds) @ np.repeat(Ss, generation.children, axis=0), np.float64)


def _views_on(views: list[AlignmentImage], centers: Array, count: int) -> list[AlignmentImage]:
    """Views that show most of the likely robot centres (H, 3), from different sides, widest first."""
    shown = []
    for view in views:
        camera = view.camera_recon
        pixels, z = camera.project(centers)
        shown.append(np.mean((z > 0) & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), 1)))
    usable = [view for view, share in zip(views, shown, strict=True) if share >= 0.7 * max(shown)]
    chosen = far_apart([view.camera_recon.center for view in usable], np.median(centers, axis=0), count)
    return [usable[i] for i in chosen]


def _transform_points(Ss: Array, points: Array) -> Array:
    """Transform points (P, 3) by each of a stack (H, 4, 4): (H, P, 3)."""
    return np.asarray(points @ np.swapaxes(Ss[:, :3, :3], 1, 2) + Ss[:, None, :3, 3], np.float64)
