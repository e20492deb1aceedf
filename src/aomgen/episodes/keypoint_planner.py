"""Plan a motion for an object of which only the keypoints in images are known."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

from aomgen.core.camera import Camera
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.values import Array
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.grasps import Grasp
from aomgen.episodes.keypoint_fit import fit_known_objects
from aomgen.episodes.planning import plan_episode
from aomgen.episodes.screening import stands_in
from aomgen.results import Results
from aomgen.simulation.episode_scene import episode_scene
from aomgen.simulation.scene import Scene

# Distances from the object that the arm keeps, and from its static link that the gripper keeps, the preferred ones first, [m]:
# the shape of the object is an estimate.
CLEARANCES_M: Final = ((0.03, 0.012), (0.03, 0.0), (0.015, 0.0), (0.004, 0.0))
# Number of the most probable shapes that are tried.
SHAPES: Final = 3


class KeypointPlanner:
    """Planner that transfers the demonstration of a run to another object of the same category.

    Args:
        results: Results of a run up to the stage "replacement", which demonstrates an opening.
        known: Closed objects that were fitted to the demonstration.
        usual_grasp: Grasp that is preferred to grasps like the demonstrated one.
    """

    def __init__(self, results: Results, known: Sequence[FittedAsset], usual_grasp: Grasp | None) -> None:
        self._factory = EpisodeFactory(results, results.folders["episodes"])
        self._known, self._usual_grasp = known, usual_grasp
        plan = replace(self._factory.plan_params, search=True)
        self._params = [
            replace(plan, clearance_m=arm, gripper_clearance_m=gripper) for arm, gripper in CLEARANCES_M
        ]

    def plan(
        self, cameras: Sequence[Camera], pixels: Array, sds_px: Array, points_world: Array, joints: Array
    ) -> EpisodePlan | Rejection:
        """Plan a motion that starts at joints (J,) of the arm.

        The other arguments are those of `fit_known_objects`.

        Returns:
            The first plan that is found for one of the most probable shapes, or the last rejection.
        """
        factory, demo = self._factory, self._factory.results.demonstration
        shapes = fit_known_objects(self._known, cameras, pixels, sds_px, points_world)
        plan = Rejection(
            reason="no_object", detail="no known object can face in the direction of the keypoints"
        )
        placed = [(*shape, self._build_scene(*shape)) for shape in shapes[:SHAPES]]
        for params, (fitted, variation, scene) in product(self._params, placed):
            plan = plan_episode(
                fitted, demo, variation, scene, factory.solver, params, self._usual_grasp, joints
            )
            if isinstance(plan, EpisodePlan):
                break
        return plan

    def _build_scene(self, fitted: FittedAsset, variation: Variation) -> Scene:
        """Build the scene of an estimated object, without obstacles that the estimate overlaps: it is not that exact."""
        factory, T = self._factory, variation.place_at(fitted)
        results = factory.results
        surroundings = results.episode_scene
        obstacles = [box for box in surroundings.obstacles if not stands_in(fitted, T, box)]
        support, bolted = surroundings.support, factory.params.bolted
        return episode_scene(results.robot, fitted, results.demonstration, support, obstacles, bolted=bolted)
