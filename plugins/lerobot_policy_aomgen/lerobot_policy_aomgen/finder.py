"""The finder: a network that locates handle and joint axis in an image of any camera, in one or two looks.

The first look sees the whole image. The second sees crops of the stored image around what the first found, at several
times its resolution: fingers tolerate 10 mm, and a pixel of the whole image at 96 px is 12 to 16 mm at the handle. The
same network takes both looks, for all cameras.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional as F

from aomgen.core.keypoints import KEYPOINTS
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes
from lerobot_policy_aomgen.lite0 import CHANNELS, MEAN, SPREAD, Lite0

# Keypoints that share a crop of the second look, which is centered between those that the first look saw.
GROUPS: Final = ((0, 1, 2), (3, 4))
# Side of the network's input, [px].
SIDE: Final = 96
# Channels of the feature pyramid.
PYRAMID: Final = 64
# Variance of a uniform heat map, in squares of its side: it knows nothing of the point.
UNIFORM: Final = 1 / 12
# Least share of certainty, so that no spread is infinite; the spread of a uniform heat map in units of its side follows.
LEAST: Final = 1e-2
UNSEEN: Final = math.sqrt(UNIFORM / LEAST)
METADATA: Final = "aomgen_finder"


@dataclass(frozen=True, kw_only=True)
class FinderSettings:
    """Settings of a finder; each of the first two can be switched off for an ablation.

    Attributes:
        second_look: Look a second time, at crops.
        pretrained: Training starts from weights that were trained on ImageNet.
        crop_px: Side of a crop of the second look in the stored image, [px].
    """

    second_look: bool = True
    pretrained: bool = True
    crop_px: int = 96


@dataclass(frozen=True, kw_only=True)
class FinderErrors:
    """Errors of a finder on images that it was not trained on, from which the noise of an action network is sampled.

    Attributes:
        cameras: Name of the camera of each of N images.
        offsets: Found minus true point (N, P, 2), divided by the focal length; NaN outside the image.
        spreads: Spread of the heat maps (N, P), divided by the focal length.
    """

    cameras: tuple[str, ...]
    offsets: Tensor
    spreads: Tensor


class Finder(nn.Module):
    """Images (B, 3, 96, 96), normalized, to logits of heat maps (B, P, 24, 24), one for each point."""

    def __init__(self, settings: FinderSettings) -> None:
        super().__init__()
        self.settings = settings
        self.trunk = Lite0()
        self.lateral = nn.ModuleList(nn.Conv2d(channels, PYRAMID, 1) for channels in CHANNELS)
        self.merge = nn.ModuleList(
            nn.Sequential(nn.Conv2d(PYRAMID, PYRAMID, 3, padding=1), nn.GroupNorm(8, PYRAMID), nn.ReLU())
            for _ in CHANNELS[:-1]
        )
        self.heat = nn.Conv2d(PYRAMID, len(KEYPOINTS), 1)

    def forward(self, images: Tensor) -> Tensor:
        *finer, features = [
            lateral(level) for lateral, level in zip(self.lateral, self.trunk(images), strict=True)
        ]
        for merge, level in zip(reversed(self.merge), reversed(finer), strict=True):
            coarse = F.interpolate(features, size=level.shape[-2:], mode="bilinear", align_corners=False)
            features = merge(coarse + level)
        return self.heat(features)

    @torch.no_grad()
    def find(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Locate the points in images (B, 3, H, W) with values 0..1.

        Returns:
            Points (B, P, 2) and their spreads (B, P), see `read_heat_maps`, [px]. The second look counts where its spread
            is smaller.
        """
        count, _, height, width = images.shape
        size = torch.tensor([width, height], dtype=torch.float32, device=images.device)
        levels = 255 * images
        points, spreads = self._look(levels, (size / 2).expand(count, 2), size.expand(count, 2))
        if not self.settings.second_look:
            return points, spreads
        span = torch.full_like(size, self.settings.crop_px).expand(count, 2)
        for group in map(list, GROUPS):
            weights = spreads[:, group, None] ** -2
            centers = (weights * points[:, group]).sum(1) / weights.sum(1)
            found, certain = self._look(levels, centers, span)
            better = certain[:, group] < spreads[:, group]
            points[:, group] = torch.where(better[..., None], found[:, group], points[:, group])
            spreads[:, group] = torch.where(better, certain[:, group], spreads[:, group])
        return points, spreads

    def _look(self, levels: Tensor, centers: Tensor, spans: Tensor) -> tuple[Tensor, Tensor]:
        """Points and spreads in pixels of the image, from a look at a part of it."""
        points, spreads = read_heat_maps(self(crop_images(levels, centers, spans)))
        return centers[:, None] + spans[:, None] * (points - 0.5), spreads * spans.mean(1, keepdim=True)


def crop_images(levels: Tensor, centers: Tensor, spans: Tensor) -> Tensor:
    """Sample parts of images at the network's size.

    Args:
        levels: Images (B, 3, H, W), 0..255.
        centers, spans: Center and size (B, 2) of the part of each image, x and y, [px]; the border repeats.

    Returns:
        Normalized images (B, 3, SIDE, SIDE).
    """
    # Averaging whole pixels first avoids aliasing.
    factor = max(int(spans.min().item() / SIDE), 1)
    pooled = F.avg_pool2d(levels, factor) if factor > 1 else levels
    covered = factor * torch.tensor(pooled.shape[:1:-1], dtype=torch.float32, device=levels.device)
    transforms = torch.zeros(len(levels), 2, 3, device=levels.device)
    transforms[:, 0, 0], transforms[:, 1, 1] = (spans / covered).T
    transforms[:, :, 2] = 2 * centers / covered - 1
    grid = F.affine_grid(transforms, [len(levels), 3, SIDE, SIDE], align_corners=False)
    sampled = F.grid_sample(pooled, grid, align_corners=False, padding_mode="border")
    return ((sampled - MEAN) / SPREAD).contiguous(memory_format=torch.channels_last)


def read_heat_maps(logits: Tensor) -> tuple[Tensor, Tensor]:
    """Read points from heat maps (B, P, h, w), in units of their side.

    Returns:
        Means (B, P, 2) and spreads (B, P): standard deviations that belong to the information which a heat map has more
        than a uniform one. A point that is not seen has a spread of many sides.
    """
    height, width = logits.shape[-2:]
    shares = logits.flatten(2).softmax(-1).view_as(logits)
    x = (torch.arange(width, device=logits.device) + 0.5) / width
    y = (torch.arange(height, device=logits.device) + 0.5) / height
    columns, rows = shares.sum(-2), shares.sum(-1)
    points = torch.stack([columns @ x, rows @ y], -1)
    variances = (torch.stack([columns @ x**2, rows @ y**2], -1) - points**2).mean(-1)
    certainties = (1 - variances / UNIFORM).clamp_min(LEAST)
    return points, (variances.clamp_min(0) / certainties).sqrt()


def save_finder(path: Path, finder: Finder, errors: FinderErrors) -> None:
    """Write a finder with its measured errors as one safetensors file.

    Raises:
        StorageError: The disk refuses.
    """
    content = {f"network.{name}": value.contiguous() for name, value in finder.state_dict().items()}
    content |= {"errors.offsets": errors.offsets, "errors.spreads": errors.spreads}
    description = {
        "settings": asdict(finder.settings),
        "keypoints": KEYPOINTS,
        "cameras": errors.cameras,
    }
    write_bytes(path, save(content, {METADATA: json.dumps(description)}))


def load_finder(path: Path) -> tuple[Finder, FinderErrors]:
    """Read what `save_finder` wrote; the finder is ready for evaluation.

    Raises:
        MissingFileError: There is no file.
        MalformedFileError: It is no finder, or one of other points.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "train a finder with lerobot_policy_aomgen.train_finder")
    try:
        with safe_open(path, "pt") as file:
            described = json.loads((file.metadata() or {})[METADATA])
            content = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        finder = Finder(FinderSettings(**described["settings"]))
        prefix = "network."
        state = {name.removeprefix(prefix): content[name] for name in content if name.startswith(prefix)}
        finder.load_state_dict(state)
        errors = FinderErrors(
            cameras=tuple(described["cameras"]),
            offsets=content["errors.offsets"],
            spreads=content["errors.spreads"],
        )
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise MalformedFileError(path, f"is no finder ({error})", "train it again") from error
    if tuple(described["keypoints"]) != KEYPOINTS:
        raise MalformedFileError(
            path, f"locates {described['keypoints']}, expected {KEYPOINTS}", "train it again"
        )
    return finder.eval(), errors
