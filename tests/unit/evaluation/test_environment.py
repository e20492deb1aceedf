"""The twin as a Gymnasium environment: the library's own check, the same bytes again, and what is refused."""

import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from aomgen.core.demonstration import SceneTrajectory
from aomgen.episodes.render import render_episode
from aomgen.errors import BackendError, ConfigError, MissingFileError
from aomgen.evaluation.environment import ENV_ID, OpenEnv
from aomgen.evaluation.rollout import World
from aomgen.io.episode_folder import list_committed, read_episode
from aomgen.io.images import resize

STEPS = 4


def make(world: World, **options) -> OpenEnv:
    return OpenEnv(world, **options)


def shaken(world: World) -> np.ndarray:
    """Actions (T, D) about the start of trial 0."""
    start = np.append(world.suite.trials[0].joints, 0.0)
    noise = np.random.default_rng(0).normal(0, 0.01, (STEPS, len(start)))
    return (start + noise).astype(np.float32)


def seen(env: OpenEnv, actions: np.ndarray) -> list[bytes]:
    observation, _ = env.reset(seed=3, options={"trial": 0})
    observations = [observation, *(env.step(action)[0] for action in actions)]
    return [
        b"".join([item["agent_pos"].tobytes(), *map(bytes, item["pixels"].values())]) for item in observations
    ]


def test_gymnasium_finds_nothing_to_complain_about(world: World) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(infinity|Box action space|alternative render modes).*")
        check_env(make(world))


def test_gymnasium_knows_it_by_its_name(world: World) -> None:
    env = gymnasium.make(ENV_ID, suite=world, disable_env_checker=True)
    assert isinstance(env.unwrapped, OpenEnv)
    with pytest.raises(MissingFileError, match=r"absent\.json: is missing"):
        gymnasium.make(ENV_ID, suite="absent.json")


def test_observations_are_named_and_ordered_as_in_the_dataset(world: World, toy) -> None:
    env = make(world)
    episode = read_episode(list_committed(toy.folders["episodes"])[0]).episode
    observation, info = env.reset(options={"trial": 1})
    assert env.observation_space.contains(observation)
    assert set(observation) == {"pixels", "agent_pos"}
    assert set(observation["pixels"]) == set(episode.cameras)
    for name, camera in episode.cameras.items():
        assert observation["pixels"][name].shape == (camera.height, camera.width, 3)
    trial = world.suite.trials[1]
    np.testing.assert_allclose(observation["agent_pos"][:6], trial.joints, atol=2e-3)
    assert env.task == env.task_description == episode.instruction
    assert info == {
        "is_success": False,
        "opening_share": info["opening_share"],
        "fail_reason": "",
        "trial": 1,
    }
    np.testing.assert_array_equal(env.render(), observation["pixels"]["front"])
    assert env.metadata["render_fps"] == episode.fps


def test_smaller_pictures_are_averaged_from_those_of_the_run(world: World) -> None:
    width, height = world.suite.drawn_size
    small = {name: camera.resize(width // 2, height // 2) for name, camera in world.suite.cameras.items()}
    halved = World(replace(world.suite, cameras=small), world.factory.results).rollout(1).observation()
    for name, picture in world.rollout(1).observation()["pixels"].items():
        blocks = picture.reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))
        np.testing.assert_allclose(halved["pixels"][name], blocks, atol=1)  # rounded after each direction


def test_a_camera_on_the_hand_shows_what_it_shows_in_an_episode(world: World, toy) -> None:
    """Against the episode's renderer, through the dataset's averaging; fixed cameras show what they showed without it."""
    robot, scene = toy.robot, toy.episode_scene
    wrist = robot.cameras["wrist"][1].resize(160, 120)
    both = World(replace(world.suite, cameras={"wrist": wrist, **world.suite.cameras}), toy).rollout(0)
    alone = world.rollout(0)
    for action in shaken(world):
        both.step(action)
        alone.step(action)
    seen, reached = both.observation()["pixels"], both.reached
    variation = both.trial.variation
    twin, layers, soft = world.factory.asset(0).show_variation(variation, world.factory.place.cameras)
    state = SceneTrajectory(
        times_s=reached.times_s,
        joints=reached.joints,
        gripper=reached.gripper,
        thetas=reached.thetas,
        T_world_object=both.T_world_object,
    )
    paths = robot.camera_paths(state.joints, state.gripper)
    drawn = render_episode(twin, robot, state, layers, scene.T_world_plane, 1, soft=soft, paths=paths)
    want = resize(drawn["wrist"].images_srgb[0], 160, 120)
    assert np.abs(seen["wrist"].astype(int) - want).max() <= 2
    for name, picture in alone.observation()["pixels"].items():
        np.testing.assert_array_equal(seen[name], picture)
    simulated = World(both.world.suite, toy, "simulator").rollout(0).observation()["pixels"]
    assert {name: picture.shape for name, picture in simulated.items()} == {
        name: picture.shape for name, picture in seen.items()
    }


def test_the_same_seed_draws_the_same_trial(world: World) -> None:
    env = make(world)
    drawn = [env.reset(seed=seed)[1]["trial"] for seed in (1, 2, 3, 4, 5, 1, 2, 3, 4, 5)]
    assert drawn[:5] == drawn[5:]
    assert len(set(drawn)) > 1


def test_the_same_actions_give_the_same_bytes(world: World, toy) -> None:
    actions = shaken(world)
    first = seen(make(world), actions)
    assert first == seen(make(World(world.suite, toy)), actions)
    assert len(set(first)) == len(first)


@pytest.mark.slow
def test_vectors_of_environments_give_the_bytes_of_one(world: World, toy) -> None:
    actions = shaken(world)
    alone = seen(make(world), actions)
    opener = partial(open_env, world.suite, toy)
    for vector in (SyncVectorEnv([opener, opener]), AsyncVectorEnv([opener, opener], context="spawn")):
        observations = [vector.reset(seed=3, options={"trial": 0})[0]]
        observations += [vector.step(np.stack([action, action]))[0] for action in actions]
        for number in range(2):
            rows = [
                b"".join(
                    [
                        item["agent_pos"][number].tobytes(),
                        *(bytes(p[number]) for p in item["pixels"].values()),
                    ]
                )
                for item in observations
            ]
            assert rows == alone
        vector.close()


def open_env(suite, results) -> OpenEnv:
    return OpenEnv(World(suite, results))


def test_the_simulator_draws_the_object_before_a_wall(world: World, toy) -> None:
    splat, simulator = (
        make(World(world.suite, toy, visuals)).reset(options={"trial": 0})[0]["pixels"]
        for visuals in ("splat", "simulator")
    )
    for name, image in simulator.items():
        assert image.shape == splat[name].shape
        # Something of both is there: MuJoCo's robot, and the wall where nothing stands before it.
        assert 0 < (image != splat[name]).any(-1).mean() < 1


def test_steps_without_a_trial_are_refused(world: World) -> None:
    env = make(world)
    with pytest.raises(ConfigError, match="call reset first"):
        env.step(np.zeros(7, np.float32))
    env.reset(options={"trial": 0})
    *_, info = env.step(np.full(7, np.nan, np.float32))
    assert (info["is_success"], info["fail_reason"]) == (False, "bad_action")
    with pytest.raises(ConfigError, match="call reset first"):
        env.step(np.zeros(7, np.float32))


@pytest.mark.parametrize("trial", [-1, 3, "first", 1.5])
def test_trials_that_do_not_exist_are_refused(world: World, trial) -> None:
    with pytest.raises(ConfigError, match="expected a number from 0 to 2"):
        make(world).reset(options={"trial": trial})


def test_unknown_visuals_are_refused(world: World) -> None:
    with pytest.raises(ConfigError, match="did you mean 'splat'"):
        make(world, visuals="splats")


def test_without_gymnasium_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "gymnasium.py").write_text("raise ImportError('hidden')")
    command = "import aomgen.evaluation.environment"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {command}"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert f"{BackendError.__name__}: gymnasium: is not installed; pip install 'aomgen[env]'" in done.stderr
