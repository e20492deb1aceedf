"""Interface of the policies that are evaluated in the twin, and baselines without learning."""

from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import pyarrow.parquet as pq

from aomgen.core.plan import EpisodePlan
from aomgen.core.transforms import quat_from_matrix
from aomgen.core.values import Array
from aomgen.datasets.features import ActionSpace, ee_deltas, feature_columns
from aomgen.datasets.lerobot_tables import SOURCE
from aomgen.errors import MissingFileError, UnknownNameError
from aomgen.evaluation.lerobot_policy import LerobotPolicy
from aomgen.evaluation.remote import SCHEMES, open_remote
from aomgen.evaluation.rollout import Rollout, World
from aomgen.evaluation.suite import nearest_pose, open_results, training_poses
from aomgen.io.artifact import file_digest
from aomgen.io.episode_folder import EPISODE_FILE, read_episode
from aomgen.pipeline.manifest import text_digest

ORACLE, NEAREST = "oracle_replay", "nearest_replay"
LEROBOT: Final = "lerobot:"
POLICIES: Final = (
    ORACLE,
    f"{NEAREST}[=RUN or DATASET]",
    f"{LEROBOT}DIR",
    *(f"{name}://HOST:PORT" for name in SCHEMES),
)


class Policy(Protocol):
    """Policy that selects actions; one object serves all trials of a suite."""

    @property
    def points_world(self) -> Array | None:
        """Return the keypoints (5, 3) that the policy located last, world frame, [m]; None if it locates none."""
        ...

    @property
    def digest(self) -> str:
        """Return the SHA-256 of what determines the actions besides name and suite: weights or demonstrations.

        It is empty if nothing else does, or if a server does not state what it serves.
        """
        ...

    def reset(self, rollout: Rollout) -> None:
        """Begin a trial. Only oracle baselines may read the true state of the rollout."""
        ...

    def looks(self, frame: int) -> bool:
        """Return whether the policy uses images at a frame; rendering takes most of the time."""
        ...

    def act(self, observation: dict[str, Any]) -> Array:
        """Return the action (D,) for an observation, which contains "pixels" if `looks` returned True."""
        ...


class OracleReplay:
    """Replay of the plan for the true pose of the trial."""

    points_world: Array | None = None
    digest = ""

    def __init__(self, world: World) -> None:
        self._world = world
        self._plan: EpisodePlan | None = None
        self._frame = 0

    def reset(self, rollout: Rollout) -> None:
        """Plan for the trial."""
        self._plan, self._frame = self._world.plan(rollout.number), 0

    def looks(self, frame: int) -> bool:
        """Return False: the policy uses no images."""
        return False

    def act(self, observation: dict[str, Any]) -> Array:
        """Return the next action of the plan."""
        if self._plan is None:
            raise ValueError("act was called before reset")
        action = choose_planned_action(self._plan, self._frame, self._world.suite.action_space)
        self._frame += 1
        return action


def choose_planned_action(plan: EpisodePlan, frame: int, space: ActionSpace) -> Array:
    """Return the action of a plan at a frame: the target for the next frame, after the end the final target."""
    now, ahead = (min(row, len(plan) - 1) for row in (frame, frame + 1))
    target, gripper = plan.Ts_world_ee[ahead], plan.gripper[ahead]
    if space == "joint":
        return np.append(plan.joints[ahead], gripper)
    if space == "ee_delta":
        return np.append(ee_deltas(plan.Ts_world_ee[now][None], target[None])[0], gripper)
    return np.concatenate([target[:3, 3], quat_from_matrix(target[:3, :3]), [gripper]])


class NearestReplay:
    """Replay of the recorded actions of the training episode with the object pose nearest to that of the trial.

    Args:
        world: World of the trials.
        training: A run, of which all episodes are used, or a dataset of the suite's run.

    Raises:
        MissingFileError: There is no episode.
    """

    points_world: Array | None = None

    def __init__(self, world: World, training: Path | None) -> None:
        self._world = world
        results, self._numbers = world.factory.results, None
        if training is not None and (training / "meta" / "info.json").is_file():
            rows = pq.read_table(training / "meta" / "episodes", columns=[SOURCE])
            self._numbers = {f"{index:06d}" for index in rows[SOURCE].to_pylist()}
        elif training is not None:
            results = open_results(training)
        self._folder = results.folders["episodes"]
        poses = training_poses(results)
        self._poses = {name: T for name, T in poses.items() if self._numbers is None or name in self._numbers}
        if not self._poses:
            raise MissingFileError(training or self._folder, "holds no episode", "finish the run first")
        self._actions, self._frame = np.zeros((0, 0)), 0

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the names and contents of the training episodes."""
        # The file of an episode contains the digests of its other files.
        files = {name: self._folder / name / EPISODE_FILE for name in self._poses}
        return text_digest("\n".join(f"{name} {file_digest(path)}" for name, path in files.items()))

    def reset(self, rollout: Rollout) -> None:
        """Find the nearest episode."""
        found = nearest_pose(rollout.T_world_object, self._poses)
        name = "" if found is None else found[1]
        episode = read_episode(self._folder / name).episode
        self._actions = feature_columns(episode, self._world.suite.action_space)["action"]
        self._frame = 0

    def looks(self, frame: int) -> bool:
        """Return False: the policy uses no images."""
        return False

    def act(self, observation: dict[str, Any]) -> Array:
        """Return the next action of the episode; after its end, the last one."""
        self._frame += 1
        return self._actions[min(self._frame, len(self._actions)) - 1]


def open_policy(name: str, world: World) -> Policy:
    """Create a policy from its name on the command line.

    Raises:
        ConfigError: There is no such policy, or it does not fit the suite.
        AomgenError: A file or server of the policy is missing or damaged.
    """
    suite = world.suite
    if name.startswith(LEROBOT):
        return LerobotPolicy(Path(name.removeprefix(LEROBOT)), suite)
    if "://" in name:
        return open_remote(name, suite, world.factory.results.robot)
    kind, _, argument = name.partition("=")
    if kind == ORACLE and not argument:
        return OracleReplay(world)
    if kind == NEAREST:
        return NearestReplay(world, Path(argument) if argument else None)
    raise UnknownNameError("--policy", name, POLICIES)
