"""LeRobot plug-in, imported by the prefix of its name, that registers its policies and `--env.type=aomgen`."""

import lerobot_env_aomgen

from lerobot_policy_aomgen.configuration_handle_act import HandleACTConfig
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig

__all__ = ["HandleACTConfig", "HandlePlanConfig", "SmallACTConfig", "lerobot_env_aomgen"]
