"""Policy `small_act`, which predicts a chunk of actions from images and joints, as offsets from the current joints.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (ACT). Its variational autoencoder is
omitted, because demonstrations of one planner differ in the observations, not in style.
"""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_aomgen.blending import ChunkBlender
from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig

# Number of channels of each cell of the feature map before all cells of an image are concatenated.
CELL_CHANNELS = 32


class SmallACTPolicy(PreTrainedPolicy):
    """Policy that is described in `SmallACTConfig`."""

    config_class = SmallACTConfig
    name = "small_act"

    def __init__(self, config: SmallACTConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config = config
        self.model = SmallACT(config)
        self.reset()

    def get_optim_params(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def reset(self) -> None:
        """Discard the last chunk, before a new episode."""
        self._blender = ChunkBlender(self.config.n_action_steps)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Compute the mean absolute error of the predicted chunks, without actions beyond the end of an episode."""
        errors = F.l1_loss(self.model(batch), batch[ACTION], reduction="none").mean(-1)
        inside = ~batch["action_is_pad"]
        loss = (errors * inside).sum() / inside.sum()
        return loss, {"l1_loss": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Predict the next actions (B, chunk_size, A)."""
        self.eval()
        return self.model(batch)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the next action (B, A); a new chunk is predicted after `n_action_steps` actions."""
        return self._blender.next_action(lambda: self.predict_action_chunk(batch))


class SmallACT(nn.Module):
    """A transformer that maps tokens of the observations to actions, with one query for each action.

    With `joint_offsets`, the output is added to the current joints. Consecutive chunks then start at the current state, whatever
    the uncertainty of the remaining path, so that the arm moves without jerks.
    """

    def __init__(self, config: SmallACTConfig) -> None:
        super().__init__()
        width = config.dim_model
        self.config = config
        self.cameras = sorted(config.image_features)
        self.encoders = nn.ModuleList(_encoder(config, name) for name in self.cameras)
        self.places = nn.Parameter(0.02 * torch.randn(len(self.cameras), config.picture_tokens, width))
        assert config.robot_state_feature is not None
        assert config.action_feature is not None
        state, action = config.robot_state_feature.shape[0], config.action_feature.shape[0]
        self.state = nn.Linear(state, width)
        self.held = nn.Linear(state, action) if config.joint_offsets else None
        if self.held is not None:
            # The mapping starts as the identity and changes little, because the statistics that normalize joints and actions
            # are similar.
            nn.init.eye_(self.held.weight)
            nn.init.zeros_(self.held.bias)
        told = config.env_state_feature
        self.environment = None if told is None else nn.Linear(told.shape[0], width)
        layer = {
            "d_model": width,
            "nhead": config.n_heads,
            "dim_feedforward": config.dim_feedforward,
            "dropout": config.dropout,
            "batch_first": True,
            "norm_first": True,
        }
        self.encoder = nn.TransformerEncoder(
            nn.TransformerEncoderLayer(**layer),
            config.n_encoder_layers,
            nn.LayerNorm(width),
            enable_nested_tensor=False,
        )
        self.decoder = nn.TransformerDecoder(
            nn.TransformerDecoderLayer(**layer), config.n_decoder_layers, nn.LayerNorm(width)
        )
        self.queries = nn.Parameter(0.02 * torch.randn(config.chunk_size, width))
        self.action = nn.Linear(width, action)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """Predict actions (B, chunk_size, A) from a batch of normalized observations."""
        state = batch[OBS_STATE]
        if self.training:
            state = state + self.config.state_noise * torch.randn_like(state)
        tokens = [self.state(state)[:, None]]
        if self.environment is not None:
            tokens.append(self.environment(batch[OBS_ENV_STATE])[:, None])
        for name, encoder, places in zip(self.cameras, self.encoders, self.places, strict=True):
            picture = _changed(batch[name], self.config) if self.training else batch[name]
            tokens.append(encoder(picture) + places)
        seen = self.encoder(torch.cat(tokens, 1))
        actions = self.action(self.decoder(self.queries.expand(len(seen), -1, -1), seen))
        return actions if self.held is None else actions + self.held(state)[:, None]


def _encoder(config: SmallACTConfig, camera: str) -> nn.Sequential:
    """Create the encoder of a camera, which maps images (B, 3, H, W) to tokens (B, N, width).

    Convolutions of stride 2 are followed by a linear layer over all cells of the feature map.
    """
    layers: list[nn.Module] = []
    _, height, width = config.image_features[camera].shape
    for before, after in zip((3, *config.channels), config.channels, strict=False):
        layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.GroupNorm(8, after), nn.ReLU()]
        height, width = (height + 1) // 2, (width + 1) // 2
    tokens, dim = config.picture_tokens, config.dim_model
    layers += [nn.Conv2d(config.channels[-1], CELL_CHANNELS, 1), nn.ReLU(), nn.Flatten()]
    layers += [nn.Linear(CELL_CHANNELS * height * width, tokens * dim), nn.Unflatten(1, (tokens, dim))]
    return nn.Sequential(*layers)


def _changed(pictures: Tensor, config: SmallACTConfig) -> Tensor:
    """Change contrast, tint and position of each image (B, 3, H, W) randomly."""
    count = len(pictures)
    contrast = 1 + config.contrast * (2 * torch.rand(count, 1, 1, 1, device=pictures.device) - 1)
    tint = config.tint * (2 * torch.rand(count, 3, 1, 1, device=pictures.device) - 1)
    return _shifted(contrast * pictures + tint, config.shift_px)


def _shifted(pictures: Tensor, most: int) -> Tensor:
    """Shift each image (B, 3, H, W) randomly by up to `most` pixels and repeat its border."""
    padded = F.pad(pictures, (most,) * 4, mode="replicate")
    height, width = pictures.shape[2:]
    offsets = torch.randint(0, 2 * most + 1, (len(pictures), 2)).tolist()
    return torch.stack(
        [picture[:, y : y + height, x : x + width] for picture, (y, x) in zip(padded, offsets, strict=True)]
    )
