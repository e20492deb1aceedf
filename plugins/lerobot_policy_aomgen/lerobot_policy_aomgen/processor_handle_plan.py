"""Processors of the policy `handle_plan`, which do not normalize values: points and poses remain in meters."""

from typing import Any

import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors

from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig


def make_handle_plan_pre_post_processors(
    config: HandlePlanConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[Any, Any]:
    """Create the processors of LeRobot's ACT policy, which use only settings that this policy has as well."""
    return make_act_pre_post_processors(config, dataset_stats)  # type: ignore[arg-type]
