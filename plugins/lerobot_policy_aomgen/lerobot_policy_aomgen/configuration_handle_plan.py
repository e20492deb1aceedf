"""Settings of the policy `handle_plan`."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import OptimizerConfig

from lerobot_policy_aomgen.detector_configuration import DetectorConfig


@PreTrainedConfig.register_subclass("handle_plan")
@dataclass
class HandlePlanConfig(DetectorConfig):
    """Settings of a policy in which a finder locates handle and joint axis, and AOMGen's planner plans the motion.

    The policy is created by `lerobot_policy_aomgen.create_handle_plan`; it is not trained with `lerobot-train`.

    Attributes:
        library: Folder of the run whose demonstration is transferred, and whose assets are the known objects.
        n_action_steps: Largest number of actions of an episode; the images of the first frame are used for all of them.
    """

    library: str = ""
    n_action_steps: int = 1000

    def validate_features(self) -> None:
        """Check the actions.

        Raises:
            ValueError: The policy has no actions.
        """
        if self.action_feature is None:
            raise ValueError("handle_plan needs the feature action: joint targets and the gripper value")

    def get_optimizer_preset(self) -> OptimizerConfig:
        """Refuse a training.

        Raises:
            ValueError: Always.
        """
        raise ValueError("handle_plan is not trained: run python -m lerobot_policy_aomgen.create_handle_plan")

    def get_scheduler_preset(self) -> None:
        return None

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
