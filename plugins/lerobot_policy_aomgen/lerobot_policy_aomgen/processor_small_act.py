"""Scaling of observations before the policy, and of actions after it, by the dataset's statistics."""

from typing import Any

import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors

from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig


def make_small_act_pre_post_processors(
    config: SmallACTConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[Any, Any]:
    """The same as for LeRobot's own ACT, whose settings have the fields that are read here."""
    return make_act_pre_post_processors(config, dataset_stats)  # type: ignore[arg-type]
