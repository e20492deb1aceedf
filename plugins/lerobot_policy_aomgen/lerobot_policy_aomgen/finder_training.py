"""Training of a finder on whole labeled images and crops of them; an interrupted training can be continued."""

import io
import math
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_bytes
from lerobot_policy_aomgen.finder import (
    GROUPS,
    SINGLE,
    Finder,
    FinderSettings,
    crop_images,
    read_heat_maps,
)
from lerobot_policy_aomgen.finder_images import LabelledImages

BATCH: Final = 32
# Number of steps between two checkpoints.
SAVE_EVERY: Final = 200
CHECKPOINT: Final = "checkpoint.pt"
# Learning rates of AdamW for new layers, and for the pretrained trunk, whose features should change only slightly.
RATE, TRUNK_RATE = 1e-3, 3e-4
WEIGHT_DECAY: Final = 1e-4
# Number of steps of the linear warmup of the learning rates, which is multiplied by a cosine decay to zero.
WARMUP: Final = 50
# Share of the crops with a random center, which teach a look to recognize that a crop contains no points.
ANYWHERE_SHARE: Final = 0.15
# Share of crops around the points of the handle, the first group of points; the others are around the axis.
HANDLE_SHARE: Final = 0.65
# Largest changes of the center, as a share of the side, and of the size, of crops and of whole images.
CROP_SHIFT, CROP_ZOOM = 0.25, 0.15
WHOLE_SHIFT, WHOLE_ZOOM = 0.04, 0.1
# Largest changes of contrast and of each color channel, in units of normalized images.
CONTRAST, TINT = 0.3, 0.3
# Standard deviation of the target heat map, [cells], and weights of the two terms of the loss.
TARGET_CELLS: Final = 1.0
HEAT_WEIGHT, POINT_WEIGHT = 0.1, 1.0


def train_finder(
    images: LabelledImages,
    settings: FinderSettings,
    steps: int,
    seed: int,
    folder: Path,
    report: Callable[[int, float], None],
) -> Finder:
    """Train a finder; an interrupted training continues from its last checkpoint in `folder`.

    Args:
        images: Labeled images.
        settings: Settings of the finder.
        steps: Number of steps of 32 images.
        seed: Seed of initial weights and samples. Interruptions do not change the result.
        folder: Folder of the checkpoint.
        report: Called after each step with its number, from 1, and its loss.

    Returns:
        The finder in evaluation mode.

    Raises:
        BackendError: Pretrained weights are requested but not installed.
        MalformedFileError: The checkpoint is damaged or belongs to another training.
        StorageError: Writing to the disk failed.
    """
    torch.manual_seed(seed)
    finder = Finder(settings)
    if settings.pretrained:
        finder.trunk.load_pretrained()
    finder = finder.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    trunk = list(finder.trunk.parameters())
    known = {id(parameter) for parameter in trunk}
    new = [parameter for parameter in finder.parameters() if id(parameter) not in known]
    groups = [
        {"params": new, "lr": RATE},
        {"params": trunk, "lr": TRUNK_RATE if settings.pretrained else RATE},
    ]
    optimizer = torch.optim.AdamW(groups, weight_decay=WEIGHT_DECAY)
    scheduler = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1, (step + 1) / WARMUP) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
    )
    parts = {"finder": finder, "optimizer": optimizer, "scheduler": scheduler}
    identity = {"settings": repr(settings), "steps": steps, "seed": seed, "images": len(images)}
    for step in range(_continue(folder / CHECKPOINT, parts, identity), steps):
        rng = np.random.default_rng([seed, step])
        loss = compute_loss(finder, *draw_batch(images, settings, rng))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        report(step + 1, loss.item())
        if (step + 1) % SAVE_EVERY == 0 or step + 1 == steps:
            state: dict[str, Any] = {name: part.state_dict() for name, part in parts.items()}
            _save(folder / CHECKPOINT, {**state, "identity": identity, "step": step + 1})
    return finder.eval()


def _save(path: Path, content: dict[str, Any]) -> None:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_bytes(path, buffer.getvalue())


def _continue(path: Path, parts: dict[str, Any], identity: dict[str, Any]) -> int:
    """Load the checkpoint if there is one, and return the number of completed steps."""
    if not path.is_file():
        return 0
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        same = content["identity"] == identity
    except (pickle.UnpicklingError, RuntimeError, KeyError, EOFError) as error:
        raise MalformedFileError(path, f"is no checkpoint ({error})", "delete it") from error
    if not same:
        raise MalformedFileError(
            path, f"belongs to {content['identity']}, not to {identity}", "choose another folder"
        )
    for name, part in parts.items():
        part.load_state_dict(content[name])
    return content["step"]


def draw_batch(
    images: LabelledImages, settings: FinderSettings, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Sample a batch of nearly whole images and crops of random images, with random changes of color.

    Returns:
        Normalized images (B, 3, SIDE, SIDE), and the points (B, P, 2) in units of their side; NaN for points behind the camera.
    """
    rows = np.array_split(rng.integers(len(images), size=BATCH), 1 + len(settings.crops_px))
    looks = [_draw_whole(images, rows[0], rng)]
    for number, crop_px in enumerate(settings.crops_px):
        looks.append(_draw_crops(images, rows[number + 1], crop_px, rng, GROUPS if number == 0 else SINGLE))
    inputs, targets = [], []
    for part, (centers, spans) in zip(rows, looks, strict=True):
        levels = torch.from_numpy(images.decode(part)).permute(0, 3, 1, 2).float()
        inputs.append(crop_images(levels, torch.from_numpy(centers).float(), torch.from_numpy(spans).float()))
        targets.append((images.points_px[part] - centers[:, None]) / spans[:, None] + 0.5)
    batch = torch.cat(inputs)
    contrast = torch.from_numpy(rng.uniform(1 - CONTRAST, 1 + CONTRAST, (BATCH, 1, 1, 1))).float()
    tint = torch.from_numpy(rng.uniform(-TINT, TINT, (BATCH, 3, 1, 1))).float()
    batch = (contrast * batch + tint).contiguous(memory_format=torch.channels_last)
    return batch, torch.from_numpy(np.concatenate(targets)).float()


def _draw_whole(
    images: LabelledImages, rows: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Sample centers and sizes (B, 2) of nearly whole images, [px]."""
    size = np.array(images.size, float)
    centers = size * (0.5 + rng.uniform(-WHOLE_SHIFT, WHOLE_SHIFT, (len(rows), 2)))
    return centers, size * rng.uniform(1 - WHOLE_ZOOM, 1 + WHOLE_ZOOM, (len(rows), 1))


def _draw_crops(
    images: LabelledImages,
    rows: np.ndarray,
    crop_px: int,
    rng: np.random.Generator,
    groups: Sequence[Sequence[int]],
) -> tuple[np.ndarray, np.ndarray]:
    """Sample centers and sizes (B, 2) of crops, [px], around the points of a group inside the image, or at random."""
    size, count = np.array(images.size, float), len(rows)
    members = np.zeros((len(groups), images.points_px.shape[1]))
    for number, group in enumerate(groups):
        members[number, list(group)] = 1
    of_handle = members[:, 0 : len(GROUPS[0])].any(1)
    chances = np.where(of_handle, HANDLE_SHARE / of_handle.sum(), (1 - HANDLE_SHARE) / (~of_handle).sum())
    seen = members[rng.choice(len(groups), count, p=chances)] * images.inside[rows]
    known = seen.any(1)
    points = np.nan_to_num(images.points_px[rows])
    around = np.einsum("np,npi->ni", seen, points) / np.maximum(seen.sum(1), 1)[:, None]
    around += crop_px * rng.uniform(-CROP_SHIFT, CROP_SHIFT, (count, 2))
    anywhere = size * rng.random((count, 2))
    free = (rng.random(count) < ANYWHERE_SHARE) | ~known
    centers = np.where(free[:, None], anywhere, around)
    return centers, np.tile(crop_px * rng.uniform(1 - CROP_ZOOM, 1 + CROP_ZOOM, (count, 1)), 2)


def compute_loss(finder: Finder, batch: Tensor, targets: Tensor) -> Tensor:
    """Compute the loss of a batch.

    It is the weighted sum of the cross entropy of the heat maps, whose targets are uniform for points outside the image, and the
    mean absolute error of the coordinates of points inside, in units of the side.

    Args:
        finder: Network in training mode.
        batch: Normalized images (B, 3, SIDE, SIDE).
        targets: Points (B, P, 2) in units of the side; NaN or outside 0..1 for points outside.
    """
    logits = finder(batch)
    height, width = logits.shape[-2:]
    inside = ((targets >= 0) & (targets < 1)).all(-1)
    known = torch.where(inside[..., None], targets, 0.5)
    x = width * known[..., :1] - 0.5 - torch.arange(width)
    y = height * known[..., 1:] - 0.5 - torch.arange(height)
    heat = torch.exp(-0.5 * (y[..., :, None] ** 2 + x[..., None, :] ** 2) / TARGET_CELLS**2).flatten(2)
    heat = torch.where(inside[..., None], heat, 1.0)
    heat = heat / heat.sum(-1, keepdim=True)
    entropy = -(heat * logits.flatten(2).log_softmax(-1)).sum(-1).mean()
    distance = (read_heat_maps(logits)[0] - known).abs().mean(-1)
    return HEAT_WEIGHT * entropy + POINT_WEIGHT * (distance * inside).sum() / inside.sum().clamp_min(1)
