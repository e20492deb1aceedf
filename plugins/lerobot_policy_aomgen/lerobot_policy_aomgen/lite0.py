"""EfficientNet-Lite0 up to stride 16 in plain PyTorch.

Source: Tan and Le, EfficientNet (2019), and the Lite variant, which has ReLU6 and no squeeze-and-excitation. The modules
have the names of the published weights, so that these are loaded strictly.
"""

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aomgen.segmentation.weights import ensure_weights

# (kernel, stride, expansion, channels, blocks) of each group of blocks; the last two groups of the network, which reach stride
# 32, are omitted.
GROUPS: Final = ((3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3))
# Numbers of the last blocks at stride 4, 8 and 16, and their channels.
LAST_BLOCKS: Final = (2, 4, 10)
CHANNELS: Final = (24, 40, 112)
# Images of 0..255 are normalized as (x - MEAN) / SPREAD.
MEAN: Final = 127.0
SPREAD: Final = 128.0


class Lite0(nn.Module):
    """Blocks 0 to 10 (0.75 million parameters), which map images (B, 3, H, W) to features at strides 4, 8 and 16."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = SameConv(3, 32, 3, stride=2, bias=False)
        self._bn0 = _norm(32)
        blocks, before = list[nn.Module](), 32
        for kernel, stride, expansion, channels, count in GROUPS:
            for number in range(count):
                blocks.append(Block(before, channels, kernel, 1 if number else stride, expansion))
                before = channels
        self._blocks = nn.ModuleList(blocks)

    def forward(self, images: Tensor) -> list[Tensor]:
        features, found = F.relu6(self._bn0(self._conv_stem(images))), []
        for number, block in enumerate(self._blocks):
            features = block(features)
            if number in LAST_BLOCKS:
                found.append(features)
        return found

    def load_pretrained(self) -> None:
        """Load the weights that were trained on ImageNet.

        Raises:
            BackendError: The weights are not installed.
        """
        path = ensure_weights("lite0")["efficientnet-lite0.pth"]
        published = torch.load(path, map_location="cpu", weights_only=True)
        self.load_state_dict({name: published[name] for name in self.state_dict()})


class Block(nn.Module):
    """An inverted residual block: pointwise expansion, depthwise convolution and pointwise projection."""

    def __init__(self, before: int, after: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = before * expansion
        self._expands, self._residual = expansion > 1, stride == 1 and before == after
        if self._expands:
            self._expand_conv = SameConv(before, wide, 1, bias=False)
            self._bn0 = _norm(wide)
        self._depthwise_conv = SameConv(wide, wide, kernel, stride=stride, groups=wide, bias=False)
        self._bn1 = _norm(wide)
        self._project_conv = SameConv(wide, after, 1, bias=False)
        self._bn2 = _norm(after)

    def forward(self, features: Tensor) -> Tensor:
        wide = F.relu6(self._bn0(self._expand_conv(features))) if self._expands else features
        wide = F.relu6(self._bn1(self._depthwise_conv(wide)))
        projected = self._bn2(self._project_conv(wide))
        return features + projected if self._residual else projected


class SameConv(nn.Conv2d):
    """A convolution with TensorFlow's "same" padding, which adds an odd pixel at the end."""

    def forward(self, input: Tensor) -> Tensor:
        kernel, stride, padding = self.kernel_size[0], self.stride[0], []
        if stride == 1:
            return F.conv2d(input, self.weight, self.bias, padding=kernel // 2, groups=self.groups)
        for size in input.shape[:1:-1]:
            total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
            padding += [total // 2, total - total // 2]
        return self._conv_forward(F.pad(input, padding), self.weight, self.bias)


def _norm(channels: int) -> nn.BatchNorm2d:
    """Create a batch normalization with the constants of the published training."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
