"""Settings that both policies have: chunks of actions, and the optimizer of a training from scratch."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig


@dataclass
class ChunkConfig(PreTrainedConfig):
    """Settings of a policy that predicts chunks of actions.

    Attributes:
        chunk_size: Number of actions that are predicted at once.
        n_action_steps: Number of these actions that are executed before the next prediction; see `ChunkBlender`.
        optimizer_lr, optimizer_weight_decay: Peak learning rate and weight decay of AdamW.
        warmup_steps, decay_steps: Lengths of the warmup and of the cosine decay of the learning rate to zero; LeRobot shortens
            both for shorter trainings.
    """

    chunk_size: int = 50
    n_action_steps: int = 5
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-4
    warmup_steps: int = 300
    decay_steps: int = 6000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps is {self.n_action_steps}, expected 1 to chunk_size = {self.chunk_size}"
            )

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.warmup_steps,
            num_decay_steps=self.decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=0.0,
        )

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None
