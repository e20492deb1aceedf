"""LeRobot imports this by its name, which makes `--env.type=aomgen --env.suite=FILE` known.

LeRobot 0.4 has no names for environments: there `lerobot_policy_aomgen` imports it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from aomgen.evaluation.environment import ENV_ID
from aomgen.evaluation.suite import read_suite


@EnvConfig.register_subclass("aomgen")
@dataclass
class AomgenEnv(EnvConfig):
    """The trials of a suite; rate, cameras and features are the suite's.

    Attributes:
        suite: File of `aomgen evaluate suite`.
        visuals: "splat", or "simulator" for MuJoCo's renderer.
    """

    suite: str = ""
    visuals: str = "splat"

    def __post_init__(self) -> None:
        found = read_suite(Path(self.suite))
        self.fps, self.task = found.fps, found.task
        self._most_steps = found.max_frames
        joints = len(found.joint_names) + 1
        self.features = {"agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(joints,))}
        self.features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=(found.action_size,))
        self.features_map = {"agent_pos": OBS_STATE, ACTION: ACTION}
        for name, camera in found.cameras.items():
            shape = (camera.height, camera.width, 3)
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"

    @property
    def gym_id(self) -> str:
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"suite": self.suite, "visuals": self.visuals, "max_episode_steps": self._most_steps}
