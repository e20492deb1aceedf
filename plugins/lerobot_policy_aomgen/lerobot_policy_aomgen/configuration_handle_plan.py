"""Settings of the policy `handle_plan`."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import OptimizerConfig

from aomgen.evaluation.known_objects import KNOWN
from lerobot_policy_aomgen.detector_configuration import DetectorConfig


@PreTrainedConfig.register_subclass("handle_plan")
@dataclass
class HandlePlanConfig(DetectorConfig):
    """Settings of a policy in which finders locate handle and joint axis, and AOMGen's planner plans the motion.

    The policy is created by `lerobot_policy_aomgen.create_handle_plan`; it is not trained with `lerobot-train`.

    Attributes:
        libraries: Folders of runs. The demonstration of the run whose instruction is the most similar to that of an episode is
            transferred; the assets of this run and parametric objects of its category are the known objects.
        finders: File of the finder for the objects of each run; required to create a policy, which then contains the finders.
        known: Number of these parametric objects.
        n_action_steps: Number of actions between two observations of the joints, by which the motion is corrected.
    """

    libraries: list[str] = field(default_factory=list)
    finders: list[str] = field(default_factory=list)
    known: int = KNOWN
    n_action_steps: int = 2

    def validate_features(self) -> None:
        """Check the actions and the finders.

        Raises:
            ValueError: The policy has no actions, or not one finder for each run.
        """
        if self.action_feature is None:
            raise ValueError("handle_plan needs the feature action: joint targets and the gripper value")
        if len(self.finders) != len(self.libraries):
            raise ValueError(f"{len(self.libraries)} runs need as many finders, not {len(self.finders)}")

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
