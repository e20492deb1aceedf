"""Processors of the policy with a finder, which change no values: points and poses stay metres."""

from typing import Any

import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors

from lerobot_policy_aomgen.configuration_handle_act import HandleACTConfig


def make_handle_act_pre_post_processors(
    config: HandleACTConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[Any, Any]:
    """The same as for LeRobot's own ACT, whose settings have the fields that are read here."""
    return make_act_pre_post_processors(config, dataset_stats)  # type: ignore[arg-type]
