"""Settings of the small policy, as `lerobot-train` takes them from its command line."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from lerobot_policy_aomgen.chunk_configuration import ChunkConfig


@PreTrainedConfig.register_subclass("small_act")
@dataclass
class SmallACTConfig(ChunkConfig):
    """Action chunking with a small convolutional encoder: about 2 million parameters for two cameras of 96x96.

    Images, state and actions are normalized; noise and color changes are in units of their standard deviations.

    The settings of chunks and optimizer are those of `ChunkConfig`.

    Attributes:
        channels: Of the encoder's convolutions; each halves the image.
        joint_offsets: Actions are joints, and predicted as offsets from the state; False for those of another kind.
        picture_tokens: Number of the encoder's tokens of an image; each may depend on all of it.
        dim_model, n_heads, dim_feedforward, n_encoder_layers, n_decoder_layers, dropout: Of the transformer.
        state_noise: Added to the state in training, so that the policy returns to the path after a deviation.
        shift_px: Largest shift of images in training, [px].
        contrast, tint: Largest change of an image's contrast, as a share, and of each of its color channels.
    """

    joint_offsets: bool = True
    channels: tuple[int, ...] = (32, 64, 96, 128)
    picture_tokens: int = 4
    dim_model: int = 128
    n_heads: int = 4
    dim_feedforward: int = 512
    n_encoder_layers: int = 1
    n_decoder_layers: int = 1
    dropout: float = 0.0
    state_noise: float = 0.015
    shift_px: int = 1
    contrast: float = 0.15
    tint: float = 0.2
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    def validate_features(self) -> None:
        """Raises ValueError without an action, a state, or an input that locates the object, and for offsets of poses."""
        if self.action_feature is None or self.robot_state_feature is None:
            raise ValueError("the dataset needs the features action and observation.state")
        if self.joint_offsets and self.action_feature.shape != self.robot_state_feature.shape:
            raise ValueError("actions are no joints: add --policy.joint_offsets=false")
        if not (self.image_features or self.env_state_feature):
            raise ValueError("the dataset needs pictures, or observation.environment_state")

    @property
    def observation_delta_indices(self) -> None:
        return None
