"""Processors of the policy `small_act`, which normalize observations and actions by the statistics of the dataset."""

from typing import Any

import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors

from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig


def make_small_act_pre_post_processors(
    config: SmallACTConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[Any, Any]:
    """Create the processors of LeRobot's ACT policy, which use only settings that this policy has as well."""
    return make_act_pre_post_processors(config, dataset_stats)  # type: ignore[arg-type]
