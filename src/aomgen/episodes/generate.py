"""Make as many verified episodes as asked for, trying variation after variation.

New places for the object are spread evenly and reproducible from a seed and an index.
Source: AOMGen, sec. 5.2 (ranges of x, y and yaw).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
from scipy.stats import qmc

from aomgen.core.camera import Camera
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.episodes.ik import IkSolver, ik_solver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.errors import NotEnoughEpisodesError
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import table_overlap_m
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan

# Kept between the recorded arm and a table that it would have hit, [m].
TABLE_CLEARANCE_M = 0.005
# An object may stand this far beyond the table's estimated edge, [m].
OVERHANG_M = 0.02
# Share of the object that each camera must show, 0..1: a corner may be cut off.
LEAST_IN_VIEW = 0.85
# Poses out of reach, off the table or out of view in a row before giving up: where one in a hundred fits, one is found.
MAX_SKIPPED = 500


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseRanges:
    """Ranges about the recorded object's pose.

    Attributes:
        x_m, y_m: Along the world's axes, [m].
        yaw_deg: About the vertical, [deg].
    """

    x_m: tuple[float, float] = (-0.05, 0.30)
    y_m: tuple[float, float] = (-0.05, 0.05)
    yaw_deg: tuple[float, float] = (-45.0, 45.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationParams:
    """What is generated.

    Attributes:
        count: Verified episodes wanted of each asset.
        seed: Of the sequences of variations; asset k uses seed + k.
        ranges: Of the poses.
        plan: How an episode is planned.
        bolted: The object is fixed to its support; False lets it stand by friction.
        cameras: Cameras that must show the action, world frame.
        attempts_per_episode: Variations tried for each wanted episode before giving up.
    """

    count: int
    seed: int = 0
    ranges: PoseRanges = field(default_factory=PoseRanges)
    plan: PlanParams = field(default_factory=PlanParams)
    bolted: bool = True
    cameras: tuple[Camera, ...] = ()
    attempts_per_episode: int = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """A variation of an asset, by name, that gave no episode, and why."""

    asset: str
    variation: Variation
    rejection: Rejection


@dataclass(frozen=True, slots=True, kw_only=True)
class Generated:
    """The outcome of a generation; variations that were filtered before planning are `skipped`."""

    episodes: tuple[VerifiedEpisode, ...]
    rejected: tuple[Rejected, ...]
    skipped: int

    @property
    def reasons(self) -> dict[str, int]:
        """How often each reason rejected a variation, most frequent first."""
        return dict(Counter(item.rejection.reason for item in self.rejected).most_common())


Outcome = VerifiedEpisode | Rejection
# Gives the outcome of a variation of an asset: read back, or made by the function.
Recall = Callable[[FittedAsset, Variation, Callable[[], Outcome]], Outcome]


def generate_episodes(
    assets: Sequence[FittedAsset],
    demo: Demonstration,
    robot: RobotModel,
    support: SupportPlane,
    params: GenerationParams,
    progress: Progress,
    recall: Recall = lambda fitted, variation, make: make(),
) -> Generated:
    """Plan and verify episodes of every asset until each has enough.

    The result depends on the arguments alone: variations come from seed and index, and an attempt
    does not depend on those before it.

    Args:
        support: What the objects stand on.
        progress: Called after every attempt.
        recall: Where outcomes of earlier runs are found; by default all are made anew.

    Raises:
        NotEnoughEpisodesError: An asset has too few after five attempts for each; says why.
    """
    solver = ik_solver(robot)
    shoulder, reach = longest_reach(robot)
    episodes: list[VerifiedEpisode] = []
    rejected: list[Rejected] = []
    skipped = 0
    for number, fitted in enumerate(assets):
        # Compiled when the first attempt is made.
        scene = cache(partial(episode_scene, robot, fitted, demo, support, params.bolted))
        attempt = partial(_attempt, scene, fitted, demo, solver, params.plan)
        tried, good, passed_over = 0, 0, 0
        for variation in variations(params.seed + number, params.ranges):
            if good >= params.count:
                break
            shown = all(in_view(variation, fitted, camera, LEAST_IN_VIEW) for camera in params.cameras)
            if not (shown and worth_trying(variation, fitted, support, shoulder, reach)):
                passed_over += 1
                if passed_over < MAX_SKIPPED:
                    continue
            if passed_over >= MAX_SKIPPED or tried >= params.count * params.attempts_per_episode:
                raise _too_few(fitted.asset.name, good, tried, passed_over, params, rejected)
            tried += 1
            result = recall(fitted, variation, partial(attempt, variation))
            if isinstance(result, Rejection):
                rejected.append(Rejected(asset=fitted.asset.name, variation=variation, rejection=result))
            else:
                episodes.append(result)
                good += 1
            share = (number + good / params.count) / len(assets)
            progress(share, f"{fitted.asset.name}: {good} of {params.count} verified, {tried} tried")
        skipped += passed_over
    return Generated(episodes=tuple(episodes), rejected=tuple(rejected), skipped=skipped)


def variations(seed: int, ranges: PoseRanges) -> Iterator[Variation]:
    """An endless low-discrepancy sequence; number i depends on the seed and i alone.

    Source: Halton's sequence, scrambled (Owen, 2017).
    """
    lows, highs = np.array([ranges.x_m, ranges.y_m, np.deg2rad(ranges.yaw_deg)]).T
    sequence = qmc.Halton(3, scramble=True, rng=np.random.default_rng(seed))
    index = 0
    while True:
        x, y, yaw = lows + sequence.random(1)[0] * (highs - lows)
        yield Variation(seed=seed, index=index, x=float(x), y=float(y), yaw=float(yaw))
        index += 1


def longest_reach(robot: RobotModel, samples: int = 2000) -> tuple[Array, float]:
    """Point about which the arm reaches farthest (3,), and how far its end effector gets, [m].

    The point is the highest one on the first joint's line that keeps the farthest sampled
    pose nearest, which for most arms is the shoulder.
    """
    rng = np.random.default_rng(0)
    low, high = np.clip(robot.joint_limits, -np.pi, np.pi).T
    joints = rng.uniform(low, high, (samples, len(low)))
    points = robot.ee_poses(joints)[:, :3, 3]
    foot = float(robot.link_poses(joints[:1], 0.0)[0, 0, 2, 3])
    heights = foot + np.linspace(0.0, 0.5, 26)
    middle = np.median(points[:, :2], axis=0)
    centres = np.array([[middle[0], middle[1], height] for height in heights])
    farthest = np.array([np.linalg.norm(points - centre, axis=1).max() for centre in centres])
    best = int(np.argmin(farthest))
    return centres[best], float(farthest[best])


def worth_trying(
    variation: Variation, fitted: FittedAsset, support: SupportPlane, shoulder_world: Array, reach_m: float
) -> bool:
    """Whether the held point stays within reach and the object on the known table.

    A coarse filter before planning: pads at arm's length leave no freedom of orientation, so nine
    tenths of the longest reach count.
    """
    T = variation.placed(fitted)
    moved = fitted.asset.joint.motion(fitted.target_theta * np.linspace(0, 1, 5))
    held = apply(T @ moved, fitted.contact_asset[None])
    if not np.linalg.norm(held - shoulder_world, axis=1).max() <= 0.9 * reach_m:
        return False
    # The recorded object stood on the table, so its place belongs to it whatever the estimate says.
    recorded = _footprint(fitted, fitted.T_world_asset)
    low = np.minimum(support.low_xy, recorded.min(0)) - OVERHANG_M
    high = np.maximum(support.high_xy, recorded.max(0)) + OVERHANG_M
    corners = _footprint(fitted, T)
    return bool(np.all(corners >= low) and np.all(corners <= high))


def _footprint(fitted: FittedAsset, T_world_object: Array) -> Array:
    """Corners of the static part seen from above (N, 2), world frame, [m]."""
    feet = np.concatenate([box.corners for box in fitted.asset.static.colliders])
    return apply(T_world_object, feet)[:, :2]


def in_view(variation: Variation, fitted: FittedAsset, camera: Camera, least_share: float) -> bool:
    """Whether a camera shows the action: the held point always, and a share 0..1 of the closed object's outline box."""
    T = variation.placed(fitted)
    moved = T @ fitted.asset.joint.motion(fitted.target_theta * np.linspace(0, 1, 5))
    held, depths = camera.project(apply(moved, fitted.contact_asset[None]))
    size = np.array([camera.width, camera.height])
    if not (np.all(depths > 0) and np.all(held >= 0) and np.all(held <= size)):
        return False
    boxes = (*fitted.asset.static.colliders, *fitted.asset.moving.colliders)
    pixels, _ = camera.project(apply(T, np.concatenate([box.corners for box in boxes])))
    low, high = pixels.min(0), pixels.max(0)
    inside = np.clip(high, 0, size) - np.clip(low, 0, size)
    return bool(np.prod(inside) >= least_share * np.prod(high - low))


def _attempt(
    scene: Callable[[], Scene],
    fitted: FittedAsset,
    demo: Demonstration,
    solver: IkSolver,
    params: PlanParams,
    variation: Variation,
) -> Outcome:
    plan = plan_episode(fitted, demo, variation, scene(), solver, params)
    return verify_plan(plan, scene()) if isinstance(plan, EpisodePlan) else plan


def episode_scene(
    robot: RobotModel, fitted: FittedAsset, demo: Demonstration, support: SupportPlane, bolted: bool
) -> Scene:
    """Robot, table and asset; a table that the recorded arm would have hit is lowered out of its way.

    An object that is not bolted needs its table where it is.
    """
    scene = build_scene(robot, fitted.asset, fitted.T_world_asset, support, bolted=bolted)
    overlap = table_overlap_m(scene, demo.joints)
    if overlap <= 0.0 or not bolted:
        return scene
    lower = replace(support, height=support.height - overlap - TABLE_CLEARANCE_M)
    return build_scene(robot, fitted.asset, fitted.T_world_asset, lower, bolted=bolted)


def _too_few(
    asset: str, good: int, tried: int, skipped: int, params: GenerationParams, rejected: list[Rejected]
) -> NotEnoughEpisodesError:
    counts = Counter(item.rejection.reason for item in rejected if item.asset == asset)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "none tried"
    return NotEnoughEpisodesError(
        asset,
        f"{good} of {params.count} episodes verified in {tried} attempts, {skipped} poses out of reach, off the "
        f"table or out of view ({reasons})",
        "ask for fewer episodes (those that are verified are kept) or choose another asset",
    )
