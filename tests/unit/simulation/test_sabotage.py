"""Sabotaged episodes: every one is rejected, and for the right reason."""

import copy
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from aomgen.assets.choice import make_asset
from aomgen.core.plan import EpisodePlan, Rejection, VerifiedEpisode
from aomgen.core.transforms import transform
from aomgen.robots.robot import RobotModel
from aomgen.simulation import replay
from aomgen.simulation.collision_check import KinematicLimits, check_kinematics, holding_gripper
from aomgen.simulation.judge import PassRule
from aomgen.simulation.scene import Scene, build_scene
from aomgen.simulation.verify import verify_plan
from toy_plans import (
    FRAMES,
    LEFT_RIGHT,
    SUPPORT,
    drawer_plan,
    facing_robot,
    microwave_plan,
    pulled,
    toy_plan,
)

Episode = tuple[EpisodePlan, Scene]


def staged(robot: RobotModel, plan: EpisodePlan) -> Episode:
    return plan, build_scene(robot, plan.fitted.asset, plan.T_world_object, SUPPORT)


@pytest.fixture(scope="module")
def drawer(robot: RobotModel) -> Episode:
    return staged(robot, drawer_plan(robot))


@pytest.fixture(scope="module")
def microwave(robot: RobotModel) -> Episode:
    return staged(robot, microwave_plan(robot))


def reason(plan: EpisodePlan, scene: Scene) -> str:
    result = verify_plan(plan, scene)
    return result.reason if isinstance(result, Rejection) else "passed"


def with_model(scene: Scene, change: Callable[[mujoco.MjModel], None]) -> Scene:
    model = copy.copy(scene.model)
    change(model)
    return replace(scene, model=model)


def shifted(plan: EpisodePlan, *way_m: float) -> EpisodePlan:
    """The object stands elsewhere than the hand believes."""
    return replace(plan, T_world_object=transform(np.eye(3), np.array(way_m)) @ plan.T_world_object)


@pytest.mark.parametrize("index", range(4))
def test_what_is_honest_passes(drawer: Episode, microwave: Episode, index: int) -> None:
    for plan, scene in (drawer, microwave):
        variation = replace(plan.variation, index=2 * index + 1)
        result = verify_plan(replace(plan, variation=variation), scene)
        assert isinstance(result, VerifiedEpisode), result


@pytest.mark.parametrize(
    "side", [(0.08, 0, 0), (0, 0, 0.08), (0, 0, -0.08), (0.06, 0.06, 0), (0.08, -0.05, 0)]
)
def test_a_hand_beside_the_handle_opens_nothing(drawer: Episode, side: tuple[float, ...]) -> None:
    plan, scene = drawer
    result = verify_plan(shifted(plan, *side), scene)
    assert isinstance(result, Rejection)
    assert result.reason == "target"
    least = PassRule().target_share
    assert result.excess == pytest.approx((least - result.metrics["target_share"]) / least)


@pytest.mark.parametrize("way", [(-0.07, 0.2, 0), (-0.07, 0, -0.14)])
def test_a_hand_that_hits_the_object_s_body_is_noticed(microwave: Episode, way: tuple[float, ...]) -> None:
    plan, scene = microwave
    assert reason(shifted(plan, *way), scene) == "robot_contact"


@pytest.mark.parametrize("near_m", [0.06, 0.1])
def test_a_hand_that_breaks_out_of_the_part_opens_it_by_pushing(drawer: Episode, near_m: float) -> None:
    plan, scene = drawer
    assert reason(shifted(plan, -near_m, 0, 0), scene) == "door_pushed"


@pytest.mark.parametrize("opened", [0.0, 0.1, 0.2, 0.3])
def test_a_gripper_that_never_closes_opens_nothing(drawer: Episode, opened: float) -> None:
    plan, scene = drawer
    assert reason(replace(plan, gripper=np.full(FRAMES, opened)), scene) == "target"


@pytest.mark.parametrize("frame", [8, 14, 18])
def test_a_grip_that_is_lost_opens_too_little(microwave: Episode, frame: int) -> None:
    plan, scene = microwave
    gripper = np.where(np.arange(FRAMES) < frame, plan.gripper, 0.0)
    assert reason(replace(plan, gripper=gripper), scene) == "target"


@pytest.mark.parametrize("share", [0.3, 0.5, 0.6])
def test_a_target_that_is_too_small_does_not_count(drawer: Episode, share: float) -> None:
    plan, scene = drawer
    small = replace(plan, fitted=replace(plan.fitted, thetas=share * plan.fitted.thetas))
    assert reason(small, scene) == "target_too_small"


@pytest.mark.parametrize("column", [0, 3, 6])
@pytest.mark.parametrize("frame", [0, 20])
def test_actions_that_are_no_numbers_never_pass(drawer: Episode, frame: int, column: int) -> None:
    plan, scene = drawer
    actions = np.column_stack([plan.joints, plan.gripper])
    actions[frame:, column] = np.nan
    assert reason(replace(plan, joints=actions[:, :-1], gripper=actions[:, -1]), scene) == "not_finite"


@pytest.mark.parametrize("stiffness", [1e6, 1e8])
def test_a_simulation_that_explodes_never_passes(drawer: Episode, stiffness: float) -> None:
    plan, scene = drawer

    def explode(model: mujoco.MjModel) -> None:
        model.opt.timestep = 0.01
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.actuator_forcelimited[:] = 0
        model.actuator_gainprm[:6, 0] = stiffness
        model.actuator_biasprm[:6, 1] = -stiffness

    assert reason(plan, with_model(scene, explode)) == "diverged"


@pytest.mark.parametrize("frame", [3, 20, 43])
@pytest.mark.parametrize("joint", [0, 1])
def test_an_arm_that_jumps_exceeds_its_torques(drawer: Episode, frame: int, joint: int) -> None:
    plan, scene = drawer
    joints = plan.joints.copy()
    joints[frame, joint] -= 0.8
    assert reason(replace(plan, joints=joints), scene) == "torque"


@pytest.mark.parametrize("share", [0.02, 0.05, 0.1])
def test_drives_that_are_too_weak_are_noticed(drawer: Episode, share: float) -> None:
    plan, scene = drawer

    def weaken(model: mujoco.MjModel) -> None:
        model.actuator_forcerange[scene.arm.actuators] *= share

    weak = replace(with_model(scene, weaken), arm=replace(scene.arm, torques=share * scene.arm.torques))
    assert reason(plan, weak) == "torque"


@pytest.mark.parametrize("share", [0.01, 0.02])
def test_servos_that_give_way_are_noticed(drawer: Episode, share: float) -> None:
    plan, scene = drawer

    def soften(model: mujoco.MjModel) -> None:
        model.actuator_gainprm[scene.arm.actuators, 0] *= share
        model.actuator_biasprm[scene.arm.actuators, 1] *= share

    assert reason(plan, with_model(scene, soften)) == "tracking"


@pytest.mark.parametrize("height", [0.16, 0.18, 0.2])
def test_an_arm_that_sweeps_through_the_table_is_noticed(drawer: Episode, height: float) -> None:
    plan, scene = drawer

    def raise_table(model: mujoco.MjModel) -> None:
        model.geom("table").pos[2] += height

    assert reason(plan, with_model(scene, raise_table)) == "robot_contact"


@pytest.mark.parametrize("offset_m", [0.035, 0.04, 0.045, 0.05])
def test_a_door_pushed_by_the_outside_of_the_hand_does_not_count(robot: RobotModel, offset_m: float) -> None:
    asset = make_asset("cabinet", 1)
    T = facing_robot(asset, (0.62, -0.15))
    plan = toy_plan(robot, asset, T, LEFT_RIGHT, pulled(0.15), offset_ee=(0.0, offset_m, 0.0))
    assert reason(*staged(robot, replace(plan, gripper=np.ones(FRAMES)))) == "door_pushed"


@pytest.mark.parametrize("offset_m", [-0.085, -0.09, -0.095])
def test_a_door_pushed_by_the_arm_does_not_count(robot: RobotModel, offset_m: float) -> None:
    asset = make_asset("cabinet", 1)
    T = facing_robot(asset, (0.55, -0.15), 0.35)
    down = np.stack([np.array([-1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0])], 1)
    plan = toy_plan(robot, asset, T, down, pulled(0.15), offset_ee=(0.0, offset_m, 0.2))
    high = replace(SUPPORT, height=0.35, low_xy=T[:2, 3] - 0.3, high_xy=T[:2, 3] + 0.3)
    scene = build_scene(robot, asset, T, high)
    assert reason(replace(plan, gripper=np.ones(FRAMES)), scene) == "door_pushed"


@pytest.mark.parametrize("turn", [0.0, 0.4, 0.7])
def test_a_hinge_on_the_wrong_side_does_not_open(robot: RobotModel, turn: float) -> None:
    honest = microwave_plan(robot)
    asset = honest.fitted.asset
    # The same box, whose door turns about the edge beside the handle.
    joint = replace(asset.joint, origin=asset.joint.origin * [-1.0, 1.0, 1.0], axis=-asset.joint.axis)
    wrong = replace(asset, joint=joint)
    plan = toy_plan(robot, asset, honest.T_world_object, LEFT_RIGHT, honest.thetas, turn=turn)
    plan = replace(plan, fitted=replace(plan.fitted, asset=wrong))
    assert reason(*staged(robot, plan)) in ("target", "torque", "tracking")


@pytest.mark.parametrize("begin_s", [0.1, 1.0, 2.0])
@pytest.mark.parametrize("grips", [True, False])
def test_a_joint_value_that_is_written_is_noticed(
    drawer: Episode, monkeypatch: pytest.MonkeyPatch, begin_s: float, grips: bool
) -> None:
    plan, scene = drawer
    step = mujoco.mj_step

    def written(model: mujoco.MjModel, data: mujoco.MjData, count: int = 1) -> None:
        step(model, data, count)
        if data.time > begin_s:
            data.qpos[scene.object_qpos] = np.interp(data.time - replay.SETTLE_S, plan.times_s, plan.thetas)
            data.qvel[scene.object_dof] = 0.0

    monkeypatch.setattr(mujoco, "mj_step", written)
    gripper = plan.gripper if grips else np.zeros(FRAMES)
    assert reason(replace(plan, gripper=gripper), scene) == "imposed"


def add_motor(spec: mujoco.MjSpec) -> None:
    spec.add_actuator(name="motor", target="object_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)


def add_follower(spec: mujoco.MjSpec) -> None:
    spec.add_equality(
        name="tie",
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1="object_joint",
        name2="elbow_joint",
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
    )


def add_weld(spec: mujoco.MjSpec) -> None:
    spec.add_equality(
        name="glue",
        type=mujoco.mjtEq.mjEQ_WELD,
        name1="object_moving",
        name2="gripper_base",
        objtype=mujoco.mjtObj.mjOBJ_BODY,
    )


def add_weld_of_sites(spec: mujoco.MjSpec) -> None:
    for body in ("object_moving", "gripper_base"):
        spec.body(body).add_site(name=f"{body}_site")
    spec.add_equality(
        name="glue",
        type=mujoco.mjtEq.mjEQ_WELD,
        name1="object_moving_site",
        name2="gripper_base_site",
        objtype=mujoco.mjtObj.mjOBJ_SITE,
    )


def add_spring(spec: mujoco.MjSpec) -> None:
    spec.joint("object_joint").stiffness = np.array([5.0, 0.0, 0.0])


@pytest.mark.parametrize("add", [add_motor, add_follower, add_weld, add_weld_of_sites, add_spring])
def test_an_object_that_something_else_moves_is_noticed(
    robot: RobotModel, drawer: Episode, monkeypatch: pytest.MonkeyPatch, add: Callable[[mujoco.MjSpec], None]
) -> None:
    plan, _ = drawer
    compiled = mujoco.MjSpec.compile

    def sabotaged(spec: mujoco.MjSpec) -> mujoco.MjModel:
        add(spec)
        return compiled(spec)

    monkeypatch.setattr(mujoco.MjSpec, "compile", sabotaged)
    assert reason(*staged(robot, plan)) == "imposed"


@pytest.mark.parametrize("softness_s", [0.1, 0.2])
def test_fingers_that_sink_into_the_handle_are_noticed(drawer: Episode, softness_s: float) -> None:
    plan, scene = drawer

    def soften(model: mujoco.MjModel) -> None:
        model.geom_solref[scene.roles.finger >= 0, 0] = softness_s

    assert reason(plan, with_model(scene, soften)) == "penetration"


@pytest.mark.parametrize("way", [0.02, 0.05])
def test_a_door_that_is_jammed_does_not_open(drawer: Episode, way: float) -> None:
    plan, scene = drawer

    def jam(model: mujoco.MjModel) -> None:
        model.joint("object_joint").range[1] = way

    assert reason(plan, with_model(scene, jam)) in ("target", "torque", "tracking")


# Tier A sees these before anything is simulated.
TIER_A = {
    "object nearer by 8 cm": (shifted, (-0.08, 0, 0), "collision"),
    "object nearer by 5 cm": (shifted, (-0.05, 0, 0), "collision"),
    "object 8 cm farther": (shifted, (0.08, 0, 0), "no_grip"),
    "object 8 cm higher": (shifted, (0, 0, 0.08), "no_grip"),
    "object 8 cm lower": (shifted, (0, 0, -0.08), "no_grip"),
}


@pytest.mark.parametrize("name", TIER_A)
def test_the_kinematic_check_sees_it_first(drawer: Episode, name: str) -> None:
    plan, scene = drawer
    change, way, wanted = TIER_A[name]
    moved = change(plan, *way)
    bar = plan.fitted.asset.handle_bar
    assert bar is not None
    held = holding_gripper(scene.robot, 2 * float(bar.half_extents.min()), 0.7)
    result = check_kinematics(
        scene.place_at(moved.T_world_object),
        plan.joints,
        np.full(FRAMES, held),
        plan.thetas,
        np.ones(FRAMES, bool),
        KinematicLimits(),
    )
    assert isinstance(result, Rejection)
    assert result.reason == wanted
