"""The small policy: pictures and joints to a chunk of actions.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (ACT), without its variational
part: demonstrations of one planner differ in what is seen, not in style.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig


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
        """Forget the actions that are left of the last chunk."""
        self._left: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

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
        """The action (B, A) of this step; the policy looks when those of its last chunk are done."""
        if not self._left:
            self._left.extend(self.predict_action_chunk(batch)[:, : self.config.n_action_steps].unbind(1))
        return self._left.popleft()


class SmallACT(nn.Module):
    """A transformer from tokens of what is observed to actions, one query each."""

    def __init__(self, config: SmallACTConfig) -> None:
        super().__init__()
        width = config.dim_model
        self.config = config
        self.cameras = sorted(config.image_features)
        self.encoders = nn.ModuleList(_encoder(config.channels, width) for _ in self.cameras)
        self.places = nn.ParameterList(
            0.02 * torch.randn(_cells(config.image_features[name].shape, len(config.channels)), width)
            for name in self.cameras
        )
        assert config.robot_state_feature is not None
        assert config.action_feature is not None
        self.state = nn.Linear(config.robot_state_feature.shape[0], width)
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
        self.action = nn.Linear(width, config.action_feature.shape[0])

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """Actions (B, chunk_size, A) for a batch of normalized observations."""
        tokens = [self.state(batch[OBS_STATE])[:, None]]
        if self.environment is not None:
            tokens.append(self.environment(batch[OBS_ENV_STATE])[:, None])
        for name, encoder, places in zip(self.cameras, self.encoders, self.places, strict=True):
            picture = batch[name]
            if self.training and self.config.shift_px:
                picture = _shifted(picture, self.config.shift_px)
            tokens.append(encoder(picture).flatten(2).transpose(1, 2) + places)
        seen = self.encoder(torch.cat(tokens, 1))
        return self.action(self.decoder(self.queries.expand(len(seen), -1, -1), seen))


def _encoder(channels: Sequence[int], width: int) -> nn.Sequential:
    """Convolutions that halve a picture (B, 3, H, W) each, and end with the transformer's width."""
    layers: list[nn.Module] = []
    for before, after in zip((3, *channels), channels, strict=False):
        layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.GroupNorm(8, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(channels[-1], width, 1))


def _cells(shape: Sequence[int], halvings: int) -> int:
    """How many cells are left of a picture of a shape (3, H, W)."""
    height, width = shape[1:]
    for _ in range(halvings):
        height, width = (height + 1) // 2, (width + 1) // 2
    return height * width


def _shifted(pictures: Tensor, most: int) -> Tensor:
    """Pictures (B, 3, H, W), each shifted by up to `most` pixels, its border repeated."""
    padded = F.pad(pictures, (most,) * 4, mode="replicate")
    height, width = pictures.shape[2:]
    offsets = torch.randint(0, 2 * most + 1, (len(pictures), 2)).tolist()
    return torch.stack(
        [picture[:, y : y + height, x : x + width] for picture, (y, x) in zip(padded, offsets, strict=True)]
    )
