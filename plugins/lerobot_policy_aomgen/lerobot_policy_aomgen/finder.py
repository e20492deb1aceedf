"""The finder, a network that locates handle and joint axis in an image of any camera.

The network is applied several times, called looks. The first look processes the whole image. Each further look processes smaller
crops of the stored image around the points that the preceding look located, at a higher resolution: the gripper tolerates errors
of 10 mm, but a pixel of the whole image at 96 px corresponds to 12 to 16 mm at the handle. All looks use the same network, for
all cameras.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional as F

from aomgen.core.keypoints import KEYPOINTS, MOVING_POINTS
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes
from lerobot_policy_aomgen.lite0 import CHANNELS, MEAN, SPREAD, Lite0

# Indices of the keypoints that share a crop of the second look, whose center is the weighted mean of their first estimates; in
# further looks, each point has its own crop.
POINTS: Final = tuple(range(len(KEYPOINTS)))
GROUPS: Final = (POINTS[:MOVING_POINTS], POINTS[MOVING_POINTS:])
SINGLE: Final = tuple((point,) for point in POINTS)
# Side of the network's input, [px].
SIDE: Final = 96
# Channels of the feature pyramid.
PYRAMID: Final = 64
# Variance of a uniform heat map, which contains no information, in units of its squared side.
UNIFORM: Final = 1 / 12
# Lower limit of the certainty, which keeps spreads finite, and the resulting spread of a uniform heat map in units of its side.
LEAST: Final = 1e-2
UNSEEN: Final = math.sqrt(UNIFORM / LEAST)
METADATA: Final = "aomgen_finder"


@dataclass(frozen=True, kw_only=True)
class FinderSettings:
    """Settings of a finder.

    Attributes:
        pretrained: Whether training starts from weights that were trained on ImageNet.
        crops_px: Side of the crops of the second look and of each further look in the stored image, [px]; empty for an ablation
            with one look.
    """

    pretrained: bool = True
    crops_px: Sequence[int] = (96,)


@dataclass(frozen=True, kw_only=True)
class FinderErrors:
    """Errors of a finder on images that it was not trained on, from which the noise of an action network is sampled.

    Attributes:
        cameras: Name of the camera of each of N images.
        offsets: Estimated minus true point (N, P, 2), divided by the focal lengths; NaN for points outside the image.
        spreads: Spreads of the estimates (N, P), divided by the focal length; see `read_heat_maps`.
    """

    cameras: tuple[str, ...]
    offsets: Tensor
    spreads: Tensor


class Finder(nn.Module):
    """A network that maps normalized images (B, 3, 96, 96) to logits of heat maps (B, P, 24, 24), one for each point."""

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
            Points (B, P, 2) and their spreads (B, P), see `read_heat_maps`, [px]. The estimate of a further look is used if its
            spread is smaller.
        """
        count, _, height, width = images.shape
        size = torch.tensor([width, height], dtype=torch.float32, device=images.device)
        levels = 255 * images
        points, spreads = self._look(levels, (size / 2).expand(count, 2), size.expand(count, 2))
        for number, crop_px in enumerate(self.settings.crops_px):
            span = torch.full_like(size, crop_px).expand(count, 2)
            for group in map(list, GROUPS if number == 0 else SINGLE):
                weights = spreads[:, group, None] ** -2
                centers = (weights * points[:, group]).sum(1) / weights.sum(1)
                found, certain = self._look(levels, centers, span)
                better = certain[:, group] < spreads[:, group]
                points[:, group] = torch.where(better[..., None], found[:, group], points[:, group])
                spreads[:, group] = torch.where(better, certain[:, group], spreads[:, group])
        return points, spreads

    def _look(self, levels: Tensor, centers: Tensor, spans: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate points (B, P, 2) and spreads (B, P), in pixels of the image, from a part of each image; see `crop_images`."""
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
    # Averaging over blocks of pixels before sampling avoids aliasing.
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
    """Compute points from the logits of heat maps (B, P, h, w).

    Returns:
        Means (B, P, 2) and spreads (B, P), in units of the side of a heat map. A spread is the standard deviation that
        corresponds to the information of a heat map in addition to that of a uniform one; that of an unobserved point is about
        `UNSEEN`.
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
    """Write a finder with its measured errors to a safetensors file.

    Raises:
        StorageError: Writing to the disk failed.
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
    """Read a finder in evaluation mode, and its errors, from a file of `save_finder`.

    Raises:
        MissingFileError: The file does not exist.
        MalformedFileError: The file contains no finder, or one of other points than `KEYPOINTS`.
    """
    if not path.is_file():
        raise MissingFileError(path, "is missing", "train a finder with lerobot_policy_aomgen.train_finder")
    try:
        with safe_open(path, "pt") as file:
            described = json.loads((file.metadata() or {})[METADATA])
            content = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        keypoints = tuple(described["keypoints"])
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
    if keypoints != KEYPOINTS:
        raise MalformedFileError(path, f"locates {keypoints}, expected {KEYPOINTS}", "train it again")
    return finder.eval(), errors
