"""LeRobot imports this by its name, which makes `--policy.type=small_act` known."""

from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig

__all__ = ["SmallACTConfig"]
