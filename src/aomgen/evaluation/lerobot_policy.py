"""Policies trained with LeRobot, `lerobot:DIR`; LeRobot itself is installed separately by `make policy-env`."""

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from aomgen.core.values import Array
from aomgen.datasets.features import TOLD, pose_vectors
from aomgen.datasets.selection import MARK
from aomgen.errors import BackendError, ConfigError, MalformedFileError, MissingFileError
from aomgen.evaluation.suite import Suite
from aomgen.io.artifact import read_json
from aomgen.pipeline.manifest import files_digest

if TYPE_CHECKING:
    from aomgen.evaluation.rollout import Rollout

# Folder of the newest weights and training settings in the output folder of `lerobot-train`.
LAST: Final = "checkpoints/last/pretrained_model"
WEIGHTS, SETTINGS, TRAINING = "model.safetensors", "config.json", "train_config.json"
# Size of the object's pose, which policies trained with `--media none` observe; the keypoints of `--media keypoints` are not
# given to any policy.
POSE_SIZE: Final = 7
STATE, IMAGES = "observation.state", "observation.images."


def checkpoint_folder(folder: Path) -> Path:
    """Find the folder of the weights in a folder of weights or in the output folder of a training.

    Raises:
        MissingFileError: The folder contains no weights.
    """
    for place in (folder, folder / LAST):
        if (place / WEIGHTS).is_file() and (place / SETTINGS).is_file():
            return place
    raise MissingFileError(
        folder, f"holds no {WEIGHTS} with {SETTINGS}", "name a folder that lerobot-train wrote"
    )


def checkpoint_digest(place: Path) -> str:
    """Return the SHA-256 of the weights and settings in a folder that `checkpoint_folder` found."""
    return files_digest([place / WEIGHTS, place / SETTINGS])


class LerobotPolicy:
    """A trained policy, which receives images when the actions of its last chunk are used up.

    Args:
        folder: Folder of weights, or output folder of a training.
        suite: Suite with which the policy has to be compatible.

    Raises:
        BackendError: LeRobot is not installed.
        MissingFileError, MalformedFileError: The weights are missing, damaged, or of an unknown type.
        ConfigError: The policy was trained on other cameras, image sizes, joints, actions or another rate.
    """

    def __init__(self, folder: Path, suite: Suite) -> None:
        try:
            import torch
            from lerobot.configs.policies import PreTrainedConfig  # pyright: ignore[reportMissingImports]
            from lerobot.policies.factory import get_policy_class, make_pre_post_processors  # pyright: ignore[reportMissingImports]
            from lerobot.utils.import_utils import register_third_party_plugins  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise BackendError(
                "lerobot",
                f"cannot be imported ({error})",
                "make policy-env; .venv-policy/bin/aomgen evaluate ...",
            ) from error
        self._torch, self._task, place = torch, suite.task, checkpoint_folder(folder)
        self._place = place
        register_third_party_plugins()
        try:
            config: Any = PreTrainedConfig.from_pretrained(place)
            policy: Any = get_policy_class(config.type).from_pretrained(place)
            self._before, self._after = make_pre_post_processors(config, str(place))
        # LeRobot does not catch the errors of its readers of JSON, weights and settings.
        except Exception as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise MalformedFileError(
                place, f"cannot be read by LeRobot ({reason})", "train it again"
            ) from error
        require_fit(config, suite, place)
        self._policy = policy.eval()
        # Policies of our plug-in that locate keypoints need the cameras of the trials.
        if hasattr(policy, "place_cameras"):
            policy.place_cameras(suite.cameras)
        self._images = list(config.image_features)
        # A policy that observes single frames observes the next one after this number of actions.
        self._steps = config.n_action_steps if config.n_obs_steps == 1 else 1
        self._told: Array | None = None if config.env_state_feature is None else np.zeros(0)
        self._left: deque[Array] = deque()

    @property
    def points_world(self) -> Array | None:
        """Return the keypoints (5, 3) that the policy located last, world frame, [m]; None if it locates none."""
        points = getattr(self._policy, "points_world", None)
        return None if points is None else np.asarray(points, np.float64)

    @property
    def digest(self) -> str:
        """Return the SHA-256 of weights and settings."""
        return checkpoint_digest(self._place)

    def reset(self, rollout: "Rollout") -> None:
        """Discard the rest of the last chunk, and read the object pose if the policy was trained with it."""
        if self._told is not None:
            self._told = pose_vectors(rollout.T_world_object[None])[0].astype(np.float32)
        self._left.clear()
        self._policy.reset()

    def looks(self, frame: int) -> bool:
        """Return whether the policy uses images and its last chunk is used up."""
        # Policies of our plug-in that plan whole motions use few images.
        return bool(self._images) and not self._left and getattr(self._policy, "uses_images", True)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the next action (D,)."""
        if not self._left:
            self._left.extend(self._ask(observation))
        return self._left.popleft()

    def chunk(self, observation: Mapping[str, Any]) -> Array:
        """Predict a whole chunk of actions (N, D), including those that are replaced by the next prediction."""
        with self._torch.no_grad():
            return self._actions(self._policy.predict_action_chunk(self._batch(observation))[0])

    def _ask(self, observation: Mapping[str, Any]) -> Array:
        """Predict the next actions (N, D) that are executed."""
        batch = self._batch(observation)
        with self._torch.no_grad():
            chosen = [self._policy.select_action(batch) for _ in range(self._steps)]
            return self._actions(self._torch.cat(chosen))

    def _batch(self, observation: Mapping[str, Any]) -> Any:
        torch = self._torch
        seen: dict[str, Any] = {STATE: torch.from_numpy(observation["agent_pos"]), "task": self._task}
        if self._told is not None:
            seen[TOLD] = torch.from_numpy(self._told)
        for name in self._images if "pixels" in observation else ():
            picture = torch.from_numpy(observation["pixels"][name.removeprefix(IMAGES)])
            seen[name] = picture.permute(2, 0, 1).float() / 255
        return self._before(seen)

    def _actions(self, scaled: Any) -> Array:
        return np.asarray(self._after(scaled).cpu(), np.float64)


def require_fit(config: Any, suite: Suite, place: Path) -> None:
    """Refuse a policy whose training data differ from a suite; the error lists every difference."""
    wanted = {name.removeprefix(IMAGES): tuple(item.shape) for name, item in config.image_features.items()}
    offered = {name: (3, camera.height, camera.width) for name, camera in suite.cameras.items()}
    problems = [
        f"camera {name} is {shape}, the suite has {offered.get(name, sorted(offered))}"
        for name, shape in wanted.items()
        if offered.get(name) != shape
    ]
    joints = len(suite.joint_names) + 1
    if config.robot_state_feature is not None and tuple(config.robot_state_feature.shape) != (joints,):
        problems.append(f"state is {tuple(config.robot_state_feature.shape)}, the suite has ({joints},)")
    told = config.env_state_feature
    if told is not None and tuple(told.shape) != (POSE_SIZE,):
        problems.append(f"environment state is {tuple(told.shape)}, the object's pose has ({POSE_SIZE},)")
    learned = _dataset_of(place)
    for name, mine, theirs in (
        ("rate", suite.fps, learned.get("fps")),
        ("action space", suite.action_space, learned.get("actions")),
    ):
        if theirs not in (None, mine):
            problems.append(f"{name} is {theirs}, the suite has {mine}")
    if problems:
        raise ConfigError(
            place, "; ".join(problems), "make a suite with the dataset's cameras, size and actions"
        )


def _dataset_of(place: Path) -> dict[str, Any]:
    """Return `fps` and `actions` of the training dataset of a policy, if the dataset still exists."""
    training = read_json(place / TRAINING) if (place / TRAINING).is_file() else {}
    root = Path(training.get("dataset", {}).get("root") or place / "no dataset")
    found = {}
    if (root / "meta" / "info.json").is_file():
        found["fps"] = read_json(root / "meta" / "info.json")["fps"]
    if (root / MARK).is_file():
        found["actions"] = read_json(root / MARK)["choices"]["actions"]
    return found
