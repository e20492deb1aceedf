"""A verified opening of a drawer in a small twin, as the exporters get it."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, CameraPath, look_at
from aomgen.core.demonstration import SceneTrajectory
from aomgen.core.episode import ContactLog
from aomgen.core.gaussians import concatenate, gaussians_of
from aomgen.exports.scene_motion import SceneMotion
from aomgen.io.artifact import load_artifact
from aomgen.io.video import encode_video
from aomgen.robots.robot import RobotModel
from aomgen.twin.twin import TwinModel
from toy_plans import drawer_plan
from toy_run import ToyResults, toy_run


class SmallResults(ToyResults):
    """A toy run whose scan had one camera."""

    @property
    def scan_cameras(self) -> dict[str, Camera]:
        pose = look_at((0, -1, 1), (0.8, 0, 0))
        return {"0001.jpg": Camera(fx=70, fy=75, cx=30, cy=25, width=64, height=48, T_world_cam=pose)}


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> SmallResults:
    made = toy_run(tmp_path_factory.mktemp("toy") / "run")
    return SmallResults(project=made.project, out=made.out, folders=made.folders, workers=1)


@pytest.fixture(scope="session")
def motion(results: SmallResults, robot: RobotModel, tmp_path_factory: pytest.TempPathFactory) -> SceneMotion:
    plan = drawer_plan(robot)
    twin = _with_arm(load_artifact(results.asset_folder(0), "twin", TwinModel), robot)
    frames = len(plan.times_s)
    video = tmp_path_factory.mktemp("video") / "front.mp4"
    images = np.random.default_rng(0).integers(0, 256, (frames, 48, 64, 3), np.uint8)
    video.write_bytes(encode_video(images, 10))
    samples = np.column_stack([plan.joints, plan.gripper])
    front = results.episode_scene.cameras["front"]
    path = CameraPath(camera=front, Ts_world_cam=robot.ee_poses(plan.joints))
    return SceneMotion(
        name="7",
        twin=twin,
        robot=robot,
        trajectory=SceneTrajectory(
            times_s=plan.times_s,
            joints=plan.joints,
            gripper=plan.gripper,
            thetas=plan.thetas,
            T_world_object=plan.T_world_object,
        ),
        commands=np.concatenate([samples, samples[-1:]]),
        cameras={"front": front},
        paths={"hand": path},
        videos={"front": video},
        video_starts_s={"front": 0.0},
        contacts=ContactLog(
            frames=np.array([10, 10, 11]),
            fingers=np.array([0, 1, 0]),
            points_world=np.full((3, 3), 0.5),
            normals_world=np.tile([1.0, 0, 0], (3, 1)),
            forces=np.array([20.0, 21.0, 19.0]),
        ),
        fitted=plan.fitted,
    )


def _with_arm(twin: TwinModel, robot: RobotModel) -> TwinModel:
    """The twin with some Gaussians of degree 1 on the forearm and in a finger."""
    rng, count = np.random.default_rng(2), 40
    blob = gaussians_of(
        means=rng.normal(0, 0.05, (count, 3)),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.02),
        opacities=np.full(count, 0.9),
        sh=rng.normal(0, 0.2, (count, 4, 3)),
    )
    bodies = np.repeat([twin.body("forearm_link"), twin.body("gripper_left_pad")], count)
    return twin.extend(concatenate([blob, blob]), bodies, np.ones(2 * count))
