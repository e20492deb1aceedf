"""Verified episodes of one asset, one draw after another."""

from collections.abc import Iterator
from itertools import count

from aomgen.core.demonstration import Demonstration, SupportPlane
from aomgen.core.plan import FittedAsset, Rejection, VerifiedEpisode
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.planning import PlanParams, plan_episode
from aomgen.episodes.variations import Ranges, draw
from aomgen.robots.robot import RobotModel
from aomgen.simulation.scene import build_scene
from aomgen.simulation.verify import verify_plan


def verified_episodes(
    fitted: FittedAsset,
    demo: Demonstration,
    robot: RobotModel,
    support: SupportPlane,
    ranges: Ranges,
    fps: float,
) -> Iterator[VerifiedEpisode]:
    """Yield episodes without end; rejected draws are skipped."""
    solver, scene = ik_solver(robot), build_scene(robot, fitted.asset, fitted.T_world_asset, support)
    for index in count():
        variation = draw(5, 0, index, ranges)
        plan = plan_episode(fitted, demo, variation, scene, solver, PlanParams(fps=fps))
        made = plan if isinstance(plan, Rejection) else verify_plan(plan, scene)
        if isinstance(made, VerifiedEpisode):
            yield made
