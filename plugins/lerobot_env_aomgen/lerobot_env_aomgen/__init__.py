"""LeRobot plug-in that registers the environment `--env.type=aomgen --env.suite=FILE`.

LeRobot imports plug-ins by the prefix of their names. LeRobot 0.4 does not do so for environments; there,
`lerobot_policy_aomgen` imports this package.
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
    """Environment with the trials of a suite, which determines frame rate, cameras and features.

    Attributes:
        suite: File written by `aomgen evaluate suite`.
        visuals: "splat" for Gaussians, or "simulator" for MuJoCo's renderer.
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
