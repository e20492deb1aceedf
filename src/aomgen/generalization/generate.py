"""Make as many verified episodes as asked for, trying variation after variation."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

from aomgen.core.camera import Camera
from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import EpisodePlan, FittedAsset, Variation, VerifiedEpisode
from aomgen.core.progress import Progress
from aomgen.core.verdict import Rejection
from aomgen.errors import NotEnoughEpisodesError
from aomgen.generalization.episode_planning import PlanParams, plan_episode
from aomgen.generalization.ik import IkSolver, ik_solver
from aomgen.generalization.variations import PoseRanges, in_view, longest_reach, variations, worth_trying
from aomgen.robots.robot import RobotModel
from aomgen.simulation.collision_check import table_overlap_m
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan

# Kept between the recorded arm and a table that it would have hit, [m].
TABLE_CLEARANCE_M = 0.005

# Share of the object that each camera must show, 0..1: a corner may be cut off.
LEAST_IN_VIEW = 0.85
# Poses out of reach, off the table or out of view in a row before giving up: where one in a hundred fits, one is found.
MAX_SKIPPED = 500


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
    """A variation that gave no episode.

    Attributes:
        asset: Name of the asset.
        variation: Where it stood.
        rejection: Why.
    """

    asset: str
    variation: Variation
    rejection: Rejection


@dataclass(frozen=True, slots=True, kw_only=True)
class Generated:
    """The outcome of a generation.

    Attributes:
        episodes: Verified, in the order of assets and variations.
        rejected: The rest of what was tried.
        skipped: Variations filtered before planning.
    """

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


def make_anew(fitted: FittedAsset, variation: Variation, make: Callable[[], Outcome]) -> Outcome:
    """A `Recall` that remembers nothing."""
    return make()


def generate_episodes(
    assets: Sequence[FittedAsset],
    demo: Demonstration,
    robot: RobotModel,
    support: SupportPlane,
    params: GenerationParams,
    progress: Progress,
    recall: Recall = make_anew,
) -> Generated:
    """Plan and verify episodes of every asset until each has enough.

    The result depends on the arguments alone: variations come from seed and index, and an attempt
    does not depend on those before it.

    Args:
        assets: From the fit.
        demo: The demonstration.
        robot: The robot of the demonstration.
        support: What the objects stand on.
        params: How many, and how.
        progress: Called after every attempt.
        recall: Where outcomes of earlier runs are found.

    Raises:
        NotEnoughEpisodesError: An asset has too few after five attempts for each; says why.
    """
    solver = ik_solver(robot)
    shoulder, reach = longest_reach(robot)
    episodes: list[VerifiedEpisode] = []
    rejected: list[Rejected] = []
    skipped = 0
    for number, fitted in enumerate(assets):
        attempt = _Attempts(fitted, demo, robot, support, params, solver)
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
            result = recall(fitted, variation, partial(attempt.make, variation))
            if isinstance(result, Rejection):
                rejected.append(Rejected(asset=fitted.asset.name, variation=variation, rejection=result))
            else:
                episodes.append(result)
                good += 1
            share = (number + good / params.count) / len(assets)
            progress(share, f"{fitted.asset.name}: {good} of {params.count} verified, {tried} tried")
        skipped += passed_over
    return Generated(episodes=tuple(episodes), rejected=tuple(rejected), skipped=skipped)


class _Attempts:
    """Plans and verifies variations of one asset; its scene is compiled when the first is made."""

    def __init__(
        self,
        fitted: FittedAsset,
        demo: Demonstration,
        robot: RobotModel,
        support: SupportPlane,
        params: GenerationParams,
        solver: IkSolver,
    ) -> None:
        self._fitted, self._demo, self._params, self._solver = fitted, demo, params, solver
        self._scene = cache(partial(_scene, robot, fitted, demo, support, params.bolted))

    def make(self, variation: Variation) -> Outcome:
        scene, params = self._scene(), self._params
        plan = plan_episode(self._fitted, self._demo, variation, scene, self._solver, params.plan)
        return verify_plan(plan, scene) if isinstance(plan, EpisodePlan) else plan


def _scene(
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
