"""The small policy: images and joints to a chunk of actions, as offsets from the current joints.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (ACT), without its variational
part: demonstrations of one planner differ in what is seen, not in style.
"""

from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_aomgen.blending import ChunkBlender
from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig

# Channels of each cell before all cells of an image are joined.
CELL_CHANNELS = 32


class SmallACTPolicy(PreTrainedPolicy):
    """See `SmallACTConfig`."""

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
        """Forget the last chunk."""
        self._blender = ChunkBlender(self.config.n_action_steps)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Mean absolute error of the chunk, what lies beyond an episode's end left out."""
        errors = F.l1_loss(self.model(batch), batch[ACTION], reduction="none").mean(-1)
        inside = ~batch["action_is_pad"]
        loss = (errors * inside).sum() / inside.sum()
        return loss, {"l1_loss": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Actions (B, chunk_size, A) from now on."""
        self.eval()
        return self.model(batch)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """The action (B, A) of this step; the policy looks when as many as it does at once are done."""
        return self._blender.next_action(lambda: self.predict_action_chunk(batch))


class SmallACT(nn.Module):
    """A transformer from tokens of what is observed to actions, one query each.

    Actions that are joints are the prediction added to the state: two predictions shortly after each other then agree to far
    less than the uncertainty of the remaining path, and the arm is not jerked.
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
            # Nearly so it stays: joints and their targets are normalized by statistics that hardly differ.
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
        """Actions (B, chunk_size, A) for a batch of normalized observations."""
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
    """From images (B, 3, H, W) of a camera to tokens (B, N, width): convolutions that halve it, then all of its cells."""
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
    """Images (B, 3, H, W), each with another contrast, tint and shift."""
    count = len(pictures)
    contrast = 1 + config.contrast * (2 * torch.rand(count, 1, 1, 1, device=pictures.device) - 1)
    tint = config.tint * (2 * torch.rand(count, 3, 1, 1, device=pictures.device) - 1)
    return _shifted(contrast * pictures + tint, config.shift_px)


def _shifted(pictures: Tensor, most: int) -> Tensor:
    """Images (B, 3, H, W), each shifted by up to `most` pixels, its border repeated."""
    padded = F.pad(pictures, (most,) * 4, mode="replicate")
    height, width = pictures.shape[2:]
    offsets = torch.randint(0, 2 * most + 1, (len(pictures), 2)).tolist()
    return torch.stack(
        [picture[:, y : y + height, x : x + width] for picture, (y, x) in zip(padded, offsets, strict=True)]
    )
