"""One unit of work in one process, from the draw to the committed episode or the rejection."""

import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.assets.usd_write import write_for_replay
from aomgen.core.camera import Camera
from aomgen.core.keypoints import move_keypoints
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation, VerifiedEpisode
from aomgen.episodes.candidates import Candidate
from aomgen.episodes.generate import MAX_SKIPPED
from aomgen.episodes.grasp_choice import DRAWS, GRASPS_FOLDER, GraspChoice, choose_grasp, draws_of
from aomgen.episodes.grasps import Grasp
from aomgen.episodes.ik import IkSolver, ik_solver
from aomgen.episodes.ledger import Unit, object_folder, write_rejection
from aomgen.episodes.parameters import GenerationParams
from aomgen.episodes.planning import Planner, plan_episode
from aomgen.episodes.pushes import push_joints
from aomgen.episodes.reach_map import ReachMap, map_reach
from aomgen.episodes.record import episode_of, store_episode
from aomgen.episodes.render import render_episode, static_layers
from aomgen.episodes.screening import Place
from aomgen.episodes.variations import draw, scale_fit
from aomgen.executors import Work
from aomgen.io.artifact import file_digest, load_artifact
from aomgen.io.atomic import stage_folder
from aomgen.io.episode_folder import episode_folder
from aomgen.io.reuse import reuse
from aomgen.lighting.object_shadow import ObjectShadow, tabulate_object_shadow
from aomgen.results import ASSET_USD, Results
from aomgen.robots.robot import longest_reach
from aomgen.simulation.episode_scene import episode_scene
from aomgen.simulation.scene import Scene
from aomgen.simulation.verify import verify_plan
from aomgen.twin.twin import StaticLayer, TwinModel
from aomgen.twin.variation import change_appearance, light_gains, scale_object

# Number of assets that a worker keeps open: the current and the next one.
OPEN_ASSETS: Final = 2
# Number of scenes that it keeps: one for the recorded size and one for that of the episode, of each asset.
OPEN_SCENES: Final = 2 * OPEN_ASSETS


class EpisodeFactory:
    """State of a worker: robot, demonstration, and the assets that it works on.

    Args:
        results: Results of the run.
        folder: Folder of all episodes.
        cameras: Cameras to use instead of the scene's.
        fitted: Assets to plan for instead of those of the run; they have no twins.
    """

    def __init__(
        self,
        results: Results,
        folder: Path,
        cameras: Mapping[str, Camera] | None = None,
        fitted: Sequence[FittedAsset] | None = None,
    ) -> None:
        self.results, self.folder, self._cameras = results, folder, cameras
        self.fitted_assets = results.fitted_assets if fitted is None else fitted
        self.params = results.params("episodes", GenerationParams())
        self.plan_params = replace(self.params.plan, fps=results.fps)
        # Methods cannot be cached per instance otherwise without keeping the instance alive.
        self.asset = lru_cache(OPEN_ASSETS)(self._open_asset)
        self.sized = lru_cache(OPEN_SCENES)(self._resize)
        self.usual_grasp = cache(self._usual_grasp)
        self._seconds: dict[str, float] = {}

    @cached_property
    def solver(self) -> IkSolver:
        """IK solver of the robot's arm; screening draws does not need it."""
        return ik_solver(self.results.robot)

    @cached_property
    def place(self) -> Place:
        """Criteria of the screening of draws."""
        scene, known = self.results.episode_scene, self.results.episode_scene.cameras
        return Place(
            ranges=self.params.ranges,
            support=scene.support,
            obstacles=scene.obstacles,
            reach=longest_reach(self.results.robot),
            cameras=self._cameras or {name: known[name] for name in self.params.cameras or known},
            free=0 if self._cameras else self.params.free_cameras,
        )

    @cached_property
    def reach_maps(self) -> tuple[ReachMap, ...]:
        """Reach maps of all assets."""
        return tuple(
            map_reach(fitted, self.results.demonstration, self.params.ranges, self.solver, self.plan_params)
            for fitted in self.fitted_assets
        )

    @cached_property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the inputs of every plan, for the certificates."""
        demo = self.results.demonstration
        arrays = np.column_stack([demo.times_s, demo.joints, demo.gripper, demo.thetas])
        return {"demonstration": hashlib.sha256(arrays.astype("<f8").tobytes()).hexdigest()}

    def screen(self, unit: Unit) -> tuple[Variation, Rejection | None]:
        """Compute the variation of a draw, and the reason why it is not worth trying, if there is one."""
        variation = self.variation(unit)
        fitted = scale_fit(self.fitted_assets[unit.asset], variation.scale)
        return variation, self.place.screen(variation, fitted)

    def variation(self, unit: Unit) -> Variation:
        """Compute the variation of a draw."""
        return draw(
            self.results.project.seed,
            unit.asset,
            unit.index,
            self.params.ranges,
            slides=self.results.robot.slides.tolist(),
            cameras=len(self.place.cameras),
            free=self.place.free,
        )

    def make(self, unit: Unit) -> tuple[bool, dict[str, float]]:
        """Plan, verify, render and commit the episode of a unit, or write why it was rejected.

        Returns:
            Whether the episode was committed, and seconds of work by step.
        """
        self._seconds = {}
        variation = self.variation(unit)
        opened = self.asset(unit.asset)
        verified = self.certify(opened, variation)
        if isinstance(verified, Rejection):
            write_rejection(self.folder, unit, variation, verified)
        else:
            self._commit(unit, verified, opened)
        return isinstance(verified, VerifiedEpisode), self._seconds

    def plan(self, opened: "OpenAsset", variation: Variation) -> EpisodePlan | Rejection:
        """Plan a variation of an asset."""
        fitted, scene = opened.sized(variation.scale)
        with self._measure_time("plan"):
            return self.plan_for(fitted, variation, scene, opened.usual_grasp)

    def plan_for(
        self, fitted: FittedAsset, variation: Variation, scene: Scene, usual: Grasp | None = None
    ) -> EpisodePlan | Rejection:
        """Plan a variation of a fitted asset in a scene from `build_scene`."""
        demo = self.results.demonstration
        return plan_episode(fitted, demo, variation, scene, self.solver, self.plan_params, usual)

    def build_scene(self, fitted: FittedAsset) -> Scene:
        """Build the scene in which an asset is planned and verified."""
        robot, demo, place = self.results.robot, self.results.demonstration, self.place
        return episode_scene(robot, fitted, demo, place.support, place.obstacles, bolted=self.params.bolted)

    def _usual_grasp(self, category: str) -> GraspChoice:
        """Return the usual grasp of a category's objects, from the stage's folder if it has been chosen."""
        chosen = self.folder / GRASPS_FOLDER
        if known := reuse(chosen / f"{category}.json", partial(load_artifact, chosen, category, GraspChoice)):
            return known
        assets = enumerate(self.fitted_assets)
        alike = [number for number, fitted in assets if fitted.asset.category == category]
        # A planner holds a copy of its scene, so only those of one object's draws are kept.
        planner = lru_cache(DRAWS)(self._open_planner)
        return choose_grasp(
            [
                [
                    (candidates[0].motion.grasp, partial(_works, planner, unit, candidates))
                    for candidates in planner(unit).list_candidates().values()
                ]
                for number in alike
                for unit in self._first_draws(number, draws_of(len(alike)))
            ]
        )

    def _first_draws(self, number: int, count: int) -> list[Unit]:
        """List the first draws of an asset that are worth planning."""
        units = (Unit(asset=number, index=index) for index in range(MAX_SKIPPED))
        return list(islice((unit for unit in units if self.screen(unit)[1] is None), count))

    def _open_planner(self, unit: Unit) -> Planner:
        variation = self.variation(unit)
        fitted, scene = self.sized(unit.asset, variation.scale)
        demo = self.results.demonstration
        return Planner(fitted, demo, variation, scene, self.solver, self.plan_params)

    def certify(self, opened: "OpenAsset", variation: Variation) -> VerifiedEpisode | Rejection:
        """Plan a variation of an asset and verify the plan."""
        plan = self.plan(opened, variation)
        if isinstance(plan, Rejection):
            return plan
        _, scene = opened.sized(variation.scale)
        with self._measure_time("verify"):
            return verify_plan(
                plan,
                scene,
                commanded=push_joints(plan, self.solver),
                limits=self._tier_a_limits(),
                digests=opened.digests,
            )

    def _tier_a_limits(self) -> dict[str, float]:
        """Return the limits of a plan's metrics, by name, for the certificate."""
        ik, contact = self.plan_params.ik, self.plan_params.kinematic
        return {"residual_mm": ik.residual_mm, "residual_deg": ik.residual_deg, **contact.by_figure}

    def _commit(self, unit: Unit, verified: VerifiedEpisode, opened: "OpenAsset") -> None:
        results, plan, images = self.results, verified.plan, self.params.images
        home = episode_folder(self.folder, unit.number)
        cameras = self.place.views(plan.variation, plan.fitted)
        reached = verified.reached
        paths = results.robot.camera_paths(reached.joints, reached.gripper) if images.robot_cameras else {}
        episode = episode_of(
            verified,
            unit.number,
            Path(os.path.relpath(self._object_usd(unit, plan, opened), home)),
            results.robot,
            results.recorded.instruction,
            cameras,
            results.alignment.joint_zeros_rad,
            paths,
        )
        with self._measure_time("draw"):
            twin, layers, soft = opened.show_variation(plan.variation, cameras)
            frames = render_episode(
                twin,
                results.robot,
                episode,
                layers,
                results.episode_scene.T_world_plane,
                1,
                soft=soft,
                paths=paths,
                points_world=move_keypoints(episode.keypoints, episode.joint, episode.thetas),
                params=images,
            )
        with self._measure_time("encode"):
            store_episode(self.folder, episode, frames, images)

    def _object_usd(self, unit: Unit, plan: EpisodePlan, opened: "OpenAsset") -> Path:
        """Return the USD file for simulating the object; one of another size is written for this episode."""
        if plan.variation.scale == 1.0:
            return opened.usd
        home = object_folder(self.folder, unit)
        with stage_folder(home) as staging:
            write_for_replay(plan.fitted.asset, staging / ASSET_USD)
        return home / ASSET_USD

    def _open_asset(self, number: int) -> "OpenAsset":
        home = self.results.asset_folder(number)
        return OpenAsset(
            factory=self,
            number=number,
            fitted=self.fitted_assets[number],
            twin=load_artifact(home, "twin", TwinModel),
            usd=home / ASSET_USD,
            digests=self.digests
            | {"asset": file_digest(home / ASSET_USD), "twin": file_digest(home / "twin.npz")},
        )

    def _resize(self, number: int, scale: float) -> tuple[FittedAsset, Scene]:
        """Return an asset at a size and the scene to plan and verify it in."""
        fitted = scale_fit(self.fitted_assets[number], scale)
        return fitted, self.build_scene(fitted)

    @contextmanager
    def _measure_time(self, part: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self._seconds[part] = self._seconds.get(part, 0.0) + time.process_time() - start


@dataclass
class OpenAsset:
    """An asset that a worker works on."""

    factory: EpisodeFactory
    number: int
    fitted: FittedAsset
    twin: TwinModel
    usd: Path
    digests: Mapping[str, str]

    @cached_property
    def usual_grasp(self) -> Grasp | None:
        """Usual grasp, which plans approximate."""
        return self.factory.usual_grasp(self.fitted.asset.category).usual

    def sized(self, scale: float) -> tuple[FittedAsset, Scene]:
        """See `EpisodeFactory.sized`."""
        return self.factory.sized(self.number, scale)

    def show_variation(
        self, variation: Variation, cameras: Mapping[str, Camera]
    ) -> tuple[TwinModel, dict[str, StaticLayer], ObjectShadow | None]:
        """Return the twin under a variation, the static layer of each camera, and the object's soft shadow.

        The layers for the recorded light and cameras are kept for the next episode.
        """
        twin = change_appearance(
            scale_object(self.twin, variation.scale), variation.light, variation.material
        )
        own = self.factory.place.cameras
        usual = cameras.keys() == own.keys() and all(cameras[name] is own[name] for name in own)
        usual &= bool((light_gains(variation.light) == 1).all())
        layers = self._layers if usual else static_layers(twin, cameras, 1)
        soft = self._soft_shadow
        return twin, layers, soft and soft.scale_by(variation.scale, twin.joint.type == "prismatic")

    @cached_property
    def _layers(self) -> dict[str, StaticLayer]:
        return static_layers(self.twin, self.factory.place.cameras, 1)

    @cached_property
    def _soft_shadow(self) -> ObjectShadow | None:
        return tabulate_object_shadow(self.twin, self.factory.results.episode_scene.T_world_plane, 1)


def _works(planner: Callable[[Unit], Planner], unit: Unit, candidates: Sequence[Candidate]) -> bool:
    return planner(unit).works(candidates)


def open_factory(results: Results, folder: Path) -> Work:
    """Open a worker function that makes units; of `results`, only the project and its folders are pickled."""
    return EpisodeFactory(results, folder).make
