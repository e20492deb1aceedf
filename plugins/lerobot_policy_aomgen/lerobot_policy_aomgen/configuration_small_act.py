"""Settings of the policy `small_act`, which `lerobot-train` reads from its command line."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from lerobot_policy_aomgen.chunk_configuration import ChunkConfig


@PreTrainedConfig.register_subclass("small_act")
@dataclass
class SmallACTConfig(ChunkConfig):
    """Settings of action chunking with a small convolutional encoder.

    The policy has about 2 million parameters for two cameras of 96x96 px. Images, state and actions are normalized; noise and
    color changes are in units of their standard deviations.

    The settings of chunks and optimizer are those of `ChunkConfig`.

    Attributes:
        joint_offsets: Whether actions are joints, which are predicted as offsets from the state.
        channels: Numbers of channels of the encoder's convolutions; each convolution halves width and height.
        picture_tokens: Number of tokens of an image; each depends on the whole image.
        dim_model, n_heads, dim_feedforward, n_encoder_layers, n_decoder_layers, dropout: Settings of the transformer.
        state_noise: Standard deviation of the noise that is added to the state in training, which teaches the policy to
            return to the path after a deviation.
        shift_px: Largest shift of images in training, [px].
        contrast, tint: Largest relative change of the contrast, and largest change of each color channel, in training.
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
        """Check the features of the dataset.

        Raises:
            ValueError: Action or state is missing, there are neither images nor object poses, or `joint_offsets` is set and
                actions are not joints.
        """
        if self.action_feature is None or self.robot_state_feature is None:
            raise ValueError("the dataset needs the features action and observation.state")
        if self.joint_offsets and self.action_feature.shape != self.robot_state_feature.shape:
            raise ValueError("actions are no joints: add --policy.joint_offsets=false")
        if not (self.image_features or self.env_state_feature):
            raise ValueError("the dataset needs pictures, or observation.environment_state")

    @property
    def observation_delta_indices(self) -> None:
        return None
