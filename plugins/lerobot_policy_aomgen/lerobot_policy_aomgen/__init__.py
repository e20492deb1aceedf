"""LeRobot imports this by its name, which makes `--policy.type=small_act` and `--env.type=aomgen` known."""

import lerobot_env_aomgen

from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig

__all__ = ["SmallACTConfig", "lerobot_env_aomgen"]
