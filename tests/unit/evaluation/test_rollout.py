"""A trial in closed loop is the certificate's simulation, one action at a time, and is judged by the same rule."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.boxes import OrientedBox
from aomgen.core.transforms import transform
from aomgen.datasets.features import ACTION_SPACES
from aomgen.errors import ConfigError
from aomgen.evaluation.evaluate import roll_out
from aomgen.evaluation.policies import OracleReplay, choose_planned_action
from aomgen.evaluation.rollout import Rollout, Targets, World
from aomgen.simulation.replay import SimulatedRun, simulate
from toy_run import toy_run


def played(world: World, number: int, actions: np.ndarray) -> Rollout:
    """A trial after some actions (T, D), or at its end."""
    rollout = world.rollout(number)
    for action in actions:
        if rollout.fail_reason is None:
            rollout.step(action)
    return rollout


def in_space(world: World, space) -> World:
    return World(replace(world.suite, action_space=space), world.factory.results)


def test_a_plan_in_closed_loop_is_the_simulation_of_its_certificate(world: World) -> None:
    plan, trial = world.plan(0), world.suite.trials[0]
    fitted, scene = world.factory.asset(0).sized(1.0)
    run = simulate(
        scene.place_at(plan.T_world_object),
        plan.joints,
        plan.gripper,
        plan.fps,
        setting=trial.setting,
        initial_theta=fitted.start_theta,
    )
    assert isinstance(run, SimulatedRun)
    rollout = world.rollout(0)
    for frame in range(40):
        tick = run.frame_ticks[frame]
        np.testing.assert_array_equal(rollout.reached.joints[0], run.joints[tick])
        assert rollout.reached.thetas[0] == run.thetas[tick]
        rollout.step(choose_planned_action(plan, frame, "joint"))


@pytest.mark.parametrize("space", ACTION_SPACES)
def test_the_plan_of_a_trial_opens_it_in_every_space(world: World, space) -> None:
    own = in_space(world, space)
    for number in range(len(own.suite.trials)):
        record = roll_out(own, OracleReplay(own), number)
        assert record.fail_reason == ""
        assert record.opening_share >= 0.9


@pytest.mark.parametrize("space", ACTION_SPACES)
def test_planned_actions_mean_the_planned_joints(world: World, space) -> None:
    plan, solver = world.plan(0), world.factory.solver
    targets = Targets(space, solver, np.append(plan.joints[0], plan.gripper[0]))
    for frame in range(0, 30):
        action = choose_planned_action(plan, frame, space)
        assert len(action) == replace(world.suite, action_space=space).action_size
        target = targets.take(action)
        assert target is not None
        T = solver.robot.ee_poses(target[None, :-1])[0]
        np.testing.assert_allclose(T, plan.Ts_world_ee[frame + 1], atol=3e-3)
        assert target[-1] == plan.gripper[frame + 1]


@pytest.mark.parametrize("space", ["ee_absolute", "ee_delta"])
def test_an_arm_that_is_nearly_stretched_does_not_lag_behind_its_hand(world: World, space) -> None:
    """There the last tenths of a millimetre are degrees of the elbow, and an arm that catches up is too fast."""
    plan, solver = world.plan(0), world.factory.solver
    joints = np.repeat(plan.joints[:1], len(plan), 0)
    elbow = np.deg2rad(3.0 + 32.0 * np.linspace(-1, 1, len(plan)) ** 2)
    joints[:, 2] = np.copysign(elbow, joints[0, 2])
    stretched = replace(plan, joints=joints, Ts_world_ee=solver.robot.ee_poses(joints))
    targets = Targets(space, solver, np.append(joints[0], 0.0))
    for frame in range(len(plan) - 1):
        target = targets.take(choose_planned_action(stretched, frame, space).astype(np.float32).astype(float))
        assert target is not None
        np.testing.assert_allclose(target[:-1], joints[frame + 1], atol=np.deg2rad(0.2))


def test_who_does_nothing_opens_nothing(world: World) -> None:
    still = np.append(world.suite.trials[0].joints, 0.0)
    rollout = played(world, 0, np.tile(still, (world.suite.max_frames, 1)))
    assert rollout.fail_reason == "target"
    assert rollout.frame == world.suite.max_frames
    assert abs(rollout.opening_share) < 0.01


def test_success_has_to_last_half_a_second(world: World) -> None:
    rollout, plan, shares = world.rollout(0), world.plan(0), []
    while rollout.fail_reason is None:
        rollout.step(choose_planned_action(plan, rollout.frame, "joint"))
        shares.append(rollout.opening_share)
    opened = np.flatnonzero(np.array(shares) >= 0.9)
    assert rollout.fail_reason == ""
    assert (opened[-1] - opened[0]) / world.suite.fps == 0.5
    assert len(opened) == 6


def test_the_plan_of_another_pose_fails(world: World) -> None:
    """With the hand beside the handle, nothing opens, or not by the fingers."""
    plan, places = world.plan(0), [world.plan(k).T_world_object for k in range(3)]
    other = max((1, 2), key=lambda k: float(np.linalg.norm(places[k][:3, 3] - places[0][:3, 3])))
    actions = np.column_stack([plan.joints, plan.gripper])[1:]
    rollout = played(world, other, np.concatenate([actions, np.tile(actions[-1], (300, 1))]))
    assert rollout.fail_reason not in (None, "")


def test_an_obstacle_in_the_path_is_touched(world: World, tmp_path: Path) -> None:
    plan = world.plan(0)
    box = OrientedBox(
        T_world_box=transform(np.eye(3), plan.Ts_world_ee[30, :3, 3]), half_extents=np.full(3, 0.06)
    )
    blocked = World(world.suite, toy_run(tmp_path, obstacles=(box,)))
    actions = np.column_stack([plan.joints, plan.gripper])[1:]
    assert not played(world, 0, actions[:30]).touched_obstacle
    assert played(blocked, 0, actions[:30]).touched_obstacle


@pytest.mark.parametrize("space", ACTION_SPACES)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_ends_the_trial(world: World, space, value: float) -> None:
    own = in_space(world, space)
    action = np.zeros(own.suite.action_size)
    action[2] = value
    rollout = played(own, 0, action[None])
    assert rollout.fail_reason == "bad_action"
    assert rollout.frame == 1


def test_no_orientation_is_no_action(world: World) -> None:
    rollout = played(in_space(world, "ee_absolute"), 0, np.zeros((1, 8)))
    assert rollout.fail_reason == "bad_action"


def test_actions_of_another_shape_are_refused(world: World) -> None:
    with pytest.raises(ConfigError, match=r"action: has shape \(8,\); expected \(7,\), the gripper last"):
        world.rollout(0).step(np.zeros(8))


def test_wild_actions_stay_within_the_joints_limits(world: World) -> None:
    low, high = world.factory.results.robot.joint_limits.T
    solver = world.factory.solver
    wild = np.append(np.full(6, 100.0), 7.0)
    target = Targets("joint", solver, np.zeros(7)).take(wild)
    assert target is not None
    np.testing.assert_array_equal(target, np.append(high, 1.0))
    assert played(world, 0, np.tile(wild, (3, 1))).frame >= 1
    assert (low < high).all()


def test_pushing_the_part_with_the_arm_does_not_count(world: World) -> None:
    """A part that has been moved by nobody's fingers is not opened: the judge is that of the certificate."""
    rollout = world.rollout(0)
    plan = world.plan(0)
    for frame in range(5):
        rollout.step(choose_planned_action(plan, frame, "joint"))
    # Somebody moves the part by hand.
    address = rollout._scene.object_qpos
    still = np.append(plan.joints[5], plan.gripper[5])
    while rollout.fail_reason is None:
        rollout._simulation.data.qpos[address] = rollout.fitted.target_theta
        rollout.step(still)
    assert rollout.fail_reason == "imposed"
