"""Folders of a run before the stage `episodes`: a robot, a table and a drawer, without trained Gaussians."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import AssetLink
from aomgen.core.boxes import OrientedBox
from aomgen.core.camera import Camera, look_at
from aomgen.core.demonstration import Demonstration, EpisodeScene, SupportPlane
from aomgen.core.gaussians import gaussians_of
from aomgen.core.light import hemisphere_light
from aomgen.core.progress import silent
from aomgen.core.project import Project
from aomgen.core.recording import RobotChoice
from aomgen.core.transforms import transform
from aomgen.episodes.grasp_choice import GRASPS_FOLDER, GraspChoice
from aomgen.episodes.grasps import grasps
from aomgen.episodes.ik import ik_solver
from aomgen.episodes.retarget import DemonstratedMotion
from aomgen.episodes.stage import run as make_episodes
from aomgen.io.artifact import save_artifact
from aomgen.results import ASSET_USD, FITTED, Results
from aomgen.robots.loading import load_robot
from aomgen.robots.robot import RobotModel
from aomgen.splatting.surfels import surfels_of
from aomgen.twin.binding import with_object
from aomgen.twin.twin import TwinModel, TwinState, body_list
from toy_drawer import SUPPORT, fitted_drawer, opening

SURFELS = 300
# Grasp of the drawer.
GRASP_NAME = "tilt +0, turn 1.00"
SIZE = (64, 48)
FOLDERS = {"replacement": "07_replacement", "episodes": "08_episodes", "dataset": "dataset"}

ROBOT = RobotChoice(
    model="ur5e_2f85",
    model_file=None,
    root=Path(),
    references=(),
    base_frame="base_link",
    joints=(),
    scan_joints=np.zeros(0),
    scan_gripper=0.0,
)


class ToyResults(Results):
    """Results that the stages `episodes` and `dataset` read; the recording is synthetic."""

    @property
    def robot(self) -> RobotModel:
        return _robot()

    @property
    def demonstration(self) -> Demonstration:
        return _demonstration()

    fps: Any = 10.0
    recorded: Any = SimpleNamespace(instruction="open the drawer", robot=ROBOT)
    alignment: Any = SimpleNamespace(joint_zeros_rad=np.zeros(6))


@cache
def _robot() -> RobotModel:
    return load_robot(ROBOT.model)


@cache
def _demonstration() -> Demonstration:
    return opening(ik_solver(_robot()), fitted_drawer())


def toy_results(
    out: Path,
    *,
    poses: int = 2,
    assets: int = 1,
    params: dict[str, Any] | None = None,
) -> ToyResults:
    """Describe the location of a toy run's existing or future results."""
    project = Project(
        capture=out,
        out=out,
        seed=5,
        assets=tuple(f"drawer:{k}" for k in range(assets)),
        poses=poses,
        params={"episodes": params or {}},
    )
    folders = {stage: out / name for stage, name in FOLDERS.items()}
    return ToyResults(project=project, out=out, folders=folders, workers=1)


def toy_run(
    out: Path, *, support: SupportPlane = SUPPORT, obstacles: tuple[OrientedBox, ...] = (), **choices: Any
) -> ToyResults:
    """Write the results of the replacement stage for some equal drawers with different names; `choices` of `toy_results`.

    Their usual grasp is given: to choose it from 24 draws takes longer than an episode.
    """
    robot, fitted, results = _robot(), fitted_drawer(), toy_results(out, **choices)
    plain = replace(fitted.asset, static=_plain(fitted.asset.static), moving=_plain(fitted.asset.moving))
    folders = results.folders
    camera = Camera(
        fx=60, fy=60, cx=32, cy=24, width=SIZE[0], height=SIZE[1],
        T_world_cam=look_at((0.6, -1.4, 1.0), (0.75, -0.2, 0.2)),
    )  # fmt: skip
    other = camera.move(look_at((0.2, 1.2, 1.0), (0.75, -0.2, 0.2)))
    light = hemisphere_light([0.8, 0.8, 0.8], [0.2, 0.2, 0.2])
    plane = transform(np.eye(3), np.array([0.0, 0.0, SUPPORT.height]))
    folders["replacement"].mkdir(parents=True)
    save_artifact(
        folders["replacement"],
        "scene",
        EpisodeScene(
            support=support,
            obstacles=obstacles,
            T_world_plane=plane,
            light=light,
            light_source="made up",
            cameras={"front": camera, "side": other},
        ),
    )
    static, moving = (
        surfels_of(link.meshes, SURFELS, np.random.default_rng(0))
        for link in (fitted.asset.static, fitted.asset.moving)
    )
    shown = DemonstratedMotion(results.demonstration)
    offered = grasps(fitted, shown.hand_at_closed(fitted), [0.01], shown.demo.ee_turn_ratio)
    usual = next(grasp for grasp in offered if grasp.name == GRASP_NAME)
    choice = GraspChoice(usual=usual, mean_rad=0.0, draws=1)
    for number in range(len(results.project.assets)):
        home = results.asset_folder(number)
        named = replace(fitted, asset=replace(plain, name=f"drawer-{number}"))
        save_artifact(home, FITTED, named)
        write_usd(fitted.asset, home / ASSET_USD)
        background = _table(robot, fitted.T_world_asset)
        twin = with_object(background, static, moving, fitted.asset.joint, light, fitted.T_world_asset)
        save_artifact(home, "twin", twin)
    save_artifact(folders["episodes"] / GRASPS_FOLDER, fitted.asset.category, choice)
    return results


def toy_episode(out: Path) -> ToyResults:
    """Write a toy run with one committed episode."""
    results = toy_run(out, poses=1)
    make_episodes(results, results.folders["episodes"], silent)
    return results


def _plain(link: AssetLink) -> AssetLink:
    """Keep the texture of the first mesh only, because textures take most of the time of writing a USD file."""
    first, *others = link.meshes
    return replace(
        link, meshes=(first, *(replace(mesh, texture_srgb=mesh.texture_srgb[:0, :0]) for mesh in others))
    )


def elsewhere(results: ToyResults, out: Path, **machine: Any) -> ToyResults:
    """Move the episodes and the dataset of a run to another folder; `machine` as in `Results`."""
    made = {stage: out / FOLDERS[stage] for stage in ("episodes", "dataset")}
    project = results.project.model_copy(update={"out": out})
    return replace(results, project=project, out=out, folders={**results.folders, **made}, **machine)


def _table(robot: RobotModel, T_world_object: np.ndarray) -> TwinModel:
    """Create a twin of a bare table, and an arm without Gaussians."""
    rng, count = np.random.default_rng(1), 400
    means = np.column_stack(
        [rng.uniform(0.2, 1.4, count), rng.uniform(-0.8, 0.6, count), np.full(count, SUPPORT.height)]
    )
    return TwinModel(
        robot=robot.name,
        gaussians=gaussians_of(
            means=means,
            quats=np.tile([1.0, 0, 0, 0], (count, 1)),
            scales=np.full((count, 3), [0.03, 0.03, 0.002]),
            opacities=np.full(count, 0.95),
            sh=rng.normal(0, 0.2, (count, 1, 3)),
        ),
        bodies=np.zeros(count, np.int32),
        labels=np.zeros(count, np.uint8),
        body_names=body_list(robot),
        joint=fitted_drawer().asset.joint,
        T_world_object=T_world_object,
        scan_state=TwinState(joints=np.zeros(6), gripper=0.0, theta=0.0, T_world_object=T_world_object),
    )
