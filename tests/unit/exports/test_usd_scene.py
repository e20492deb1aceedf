"""The USD scene, read back: images, poses over time, joints and limits, masses, cameras, and USD's own validators."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics, UsdValidation

from aomgen.core.transforms import invert
from aomgen.exports.scene_motion import SceneMotion
from aomgen.exports.simulated_scene import simulate_motion_scene
from aomgen.exports.usd_scene import write_usd_scene
from aomgen.results import Results
from aomgen.simulation.scene import Scene
from aomgen.splatting.metrics import psnr
from aomgen.splatting.rasterizer import render
from aomgen.twin.twin import move_bodies, pose_bodies
from usd_scene_reader import camera_of, choose, gaussians_at, joints_of, poses_at


@pytest.fixture(scope="module")
def file(results: Results, motion: SceneMotion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("usd") / "scene.usdc"
    write_usd_scene(results, motion, path)
    return path


@pytest.fixture
def stage(file: Path) -> Usd.Stage:
    return Usd.Stage.Open(str(file))


@pytest.fixture(scope="module")
def scene(results: Results, motion: SceneMotion) -> Scene:
    return simulate_motion_scene(results, motion)


def validate(path: Path) -> list[str]:
    """What USD's validators find in a file."""
    found, stage = list[str](), Usd.Stage.Open(str(path))
    for motion in ("physics", "demonstration"):
        choose(stage, motion)
        context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
        found += [item.GetErrorAsString() for item in context.Validate(stage)]
    return found


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_the_validators_find_nothing(
    results: Results, motion: SceneMotion, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"scene{suffix}"
    write_usd_scene(results, motion, path)
    assert validate(path) == []
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_frames_and_units(stage: Usd.Stage, motion: SceneMotion) -> None:
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    assert stage.GetTimeCodesPerSecond() == 10
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, len(motion.trajectory) - 1)


def test_every_frame_looks_as_the_twin(stage: Usd.Stage, motion: SceneMotion) -> None:
    camera = motion.cameras["front"].resize(320, 240)
    for frame in (0, 25, len(motion.trajectory) - 1):
        # Light falls on the bodies as in the first frame.
        lit = pose_bodies(motion.twin, motion.Ts_world_body[0])
        Ts = motion.Ts_world_body[frame] @ invert(motion.Ts_world_body[0])
        wanted = render(move_bodies(lit, motion.twin.bodies, Ts), camera).rgb
        assert psnr(render(gaussians_at(stage, frame), camera).rgb, wanted) >= 60
    choose(stage, "physics")
    start = render(pose_bodies(motion.twin, motion.Ts_world_body[0]), camera).rgb
    assert psnr(render(gaussians_at(stage), camera).rgb, start) >= 60


def test_bodies_move_as_in_the_motion(stage: Usd.Stage, motion: SceneMotion) -> None:
    for frame in (0, 17, len(motion.trajectory) - 1):
        found = poses_at(stage, frame)
        for number, name in enumerate(motion.twin.body_names[1:], start=1):
            np.testing.assert_allclose(found[name], motion.Ts_world_body[frame, number], atol=1e-9)


def test_joints_limits_and_masses(stage: Usd.Stage, scene: Scene, motion: SceneMotion) -> None:
    choose(stage, "physics")
    model, data, found = scene.model, mujoco.MjData(scene.model), joints_of(stage)
    moved = motion.trajectory
    data.qpos[:] = scene.qpos(moved.joints[:1], moved.gripper[:1], moved.thetas[:1])[0]
    mujoco.mj_kinematics(model, data)
    assert len(found) == model.njnt
    for number in range(model.njnt):
        joint, child = found[model.joint(number).name]
        np.testing.assert_allclose(joint.axis, data.xaxis[number], atol=1e-6)
        np.testing.assert_allclose(joint.origin, data.xanchor[number], atol=1e-6)
        np.testing.assert_allclose(child, data.xanchor[number], atol=1e-6)
        np.testing.assert_allclose([joint.lower, joint.upper], model.jnt_range[number], atol=1e-6)
    names = {scene.names.static_body: "object", scene.names.moving_body: "part"}
    for body in range(1, model.nbody):
        name = model.body(body).name
        prims = [prim for prim in stage.Traverse() if prim.GetName() == names.get(name, name)]
        if name in scene.robot.body_names or name in names:
            mass = UsdPhysics.MassAPI(prims[0]).GetMassAttr().Get()
            # A body without mass has one gram, because 0 means "unknown" to USD.
            np.testing.assert_allclose(mass, max(model.body_mass[body], 1e-3), rtol=1e-6)


def test_an_articulation_that_physics_moves(stage: Usd.Stage) -> None:
    choose(stage, "physics")
    roots = [str(prim.GetPath()) for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
    assert roots == ["/World/Robot", "/World/Object"]
    colliders = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.CollisionAPI)]
    assert len(colliders) > 30
    assert {UsdGeom.Imageable(prim).GetPurposeAttr().Get() for prim in colliders} == {"guide"}
    part = stage.GetPrimAtPath("/World/Object/part")
    assert not UsdPhysics.RigidBodyAPI(part).GetKinematicEnabledAttr().Get()
    assert not UsdGeom.Xformable(part).GetTimeSamples()
    choose(stage, "demonstration")
    assert UsdPhysics.RigidBodyAPI(part).GetKinematicEnabledAttr().Get()
    assert len(UsdGeom.Xformable(part).GetTimeSamples()) == stage.GetEndTimeCode() + 1


def test_drives_are_told_the_commands(stage: Usd.Stage, motion: SceneMotion, robot) -> None:
    elbow = stage.GetPrimAtPath("/World/Robot/joints/elbow_joint")
    drive = UsdPhysics.DriveAPI(elbow, "angular")
    column = robot.joint_names.index("elbow_joint")
    for frame in (0, 20, len(motion.trajectory)):
        np.testing.assert_allclose(
            np.deg2rad(drive.GetTargetPositionAttr().Get(frame)), motion.commands[frame, column], atol=1e-6
        )
    # The UR5e's model has 2000 N m/rad.
    np.testing.assert_allclose(drive.GetStiffnessAttr().Get(), 2000 * np.pi / 180, rtol=1e-6)
    finger = stage.GetPrimAtPath("/World/Robot/joints/gripper_left_driver_joint")
    closed = UsdPhysics.DriveAPI(finger, "angular").GetTargetPositionAttr().Get(25)
    np.testing.assert_allclose(np.deg2rad(closed), 0.8 * motion.commands[25, -1], atol=1e-6)


def test_cameras(stage: Usd.Stage, motion: SceneMotion, results: Results) -> None:
    scan = results.scan_cameras["0001.jpg"]
    views = [("front", motion.cameras["front"], None), ("scan_0001_jpg", scan, None)]
    views += [("hand", motion.paths["hand"].at(frame), frame) for frame in (0, 30)]
    for name, wanted, frame in views:
        found = camera_of(stage, f"/World/Cameras/{name}", frame)
        for key in ("fx", "fy", "cx", "cy"):
            np.testing.assert_allclose(getattr(found, key), getattr(wanted, key), rtol=1e-5)
        np.testing.assert_allclose(found.T_world_cam, wanted.T_world_cam, atol=1e-7)


def test_the_example_reads_the_commands(file: Path, motion: SceneMotion) -> None:
    name = Path(__file__).parents[3] / "examples" / "isaac_lab_twin.py"
    spec = importlib.util.spec_from_file_location(name.stem, name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert "never run in Isaac Lab" in module.__doc__
    found = module.read_commands(file)
    arm = [found.joints.index(joint) for joint in motion.robot.joint_names]
    np.testing.assert_allclose(found.positions[:, arm], motion.commands[:, :-1], atol=1e-6)
    assert set(found.joints) - set(motion.robot.joint_names) == {
        "gripper_left_driver_joint",
        "gripper_right_driver_joint",
    }
    steps = np.diff(motion.commands[:, :-1], axis=0) * found.fps
    np.testing.assert_allclose(found.velocities[:-1, arm], steps, atol=1e-4)
