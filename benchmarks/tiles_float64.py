"""Reference of the rasterizer, in float64 and only on chosen tiles, so that large scenes are feasible."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from aomgen.core.camera import Camera
from benchmarks.projection import (
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_DEPTH,
    PARAMETERS,
    Splats,
    project,
)

TILE_PX = 16
# A pixel is undecided when float32 may take another branch than float64 there: an alpha or the
# remaining light is this close (relative) to its limit, or two splats on it this close (relative) in depth.
NEAR_LIMIT = 1e-3
NEAR_TIE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class TileImages:
    """Images of some tiles over black, zero elsewhere.

    Attributes:
        planes: (5, H, W) float64: red, green, blue, depth [m, not divided by alpha], alpha.
        decided: (H, W) bool, pixels of the tiles on which rounding cannot change the set of splats.
        blended: Number of pairs of a splat and a pixel whose alpha counts.
    """

    planes: Tensor
    decided: Tensor
    blended: int


def choose_tiles(camera: Camera, count: int, seed: int) -> NDArray[np.int64]:
    """Choose columns and rows (T, 2) of up to `count` different tiles, at random."""
    columns, rows = -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(columns * rows, min(count, columns * rows), replace=False)
    return np.stack([chosen % columns, chosen // columns], 1)


def tile_mask(camera: Camera, tiles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) in one of the tiles."""
    mask = np.zeros((camera.height, camera.width), bool)
    for column, row in tiles:
        mask[_window(camera, int(column), int(row))] = True
    return mask


class TileReference:
    """Reference for the tiles of one view of one scene.

    Args:
        parameters: Tensors by the names in `PARAMETERS`, any float type, taken as exact.
        camera: View in the frame of the means.
        degree: Spherical harmonics that are evaluated, 0..3.
        tiles: Columns and rows (T, 2).
    """

    def __init__(
        self, parameters: dict[str, Tensor], camera: Camera, degree: int, tiles: NDArray[np.int64]
    ) -> None:
        exact = {name: parameters[name].double() for name in PARAMETERS}
        with torch.no_grad():
            boxes = project(exact, camera, 0)
        hits = [_hits(boxes, int(column), int(row)) for column, row in tiles]
        self._seen = torch.stack(hits).any(0).nonzero()[:, 0]
        place = torch.full((len(exact["means"]),), -1)
        place[self._seen] = torch.arange(len(self._seen))
        self._leaves = {name: tensor[self._seen].requires_grad_() for name, tensor in exact.items()}
        self._shapes = {name: tensor.shape for name, tensor in exact.items()}
        self._splats = project(self._leaves, camera, degree)
        depths = self._splats.values.detach()[:, 3]
        self._work = []
        for (column, row), hit in zip(tiles, hits, strict=True):
            near = place[hit.nonzero()[:, 0]]
            near = near[torch.argsort(depths[near], stable=True)]
            self._work.append((*_window(camera, int(column), int(row)), near))
        self._image_shape = (camera.height, camera.width)

    def images(self) -> TileImages:
        """Render the tiles."""
        planes = torch.zeros((5, *self._image_shape), dtype=torch.float64)
        decided = torch.zeros(self._image_shape, dtype=torch.bool)
        blended = 0
        with torch.no_grad():
            for rows, columns, near in self._work:
                splats = [tensor[near] for tensor in self._splats.differentiable()]
                planes[:, rows, columns] = _blend(splats, rows, columns)
                decided[rows, columns], count = _decided(splats, rows, columns)
                blended += count
        return TileImages(planes=planes, decided=decided, blended=blended)

    def gradients(self, grad_planes: Tensor) -> dict[str, Tensor]:
        """Compute a loss's gradient by every parameter (float64), from its gradient by the planes (5, H, W).

        Values of `grad_planes` outside the tiles are ignored.
        """
        joints = self._splats.differentiable()
        cut = [tensor.detach().requires_grad_() for tensor in joints]
        for rows, columns, near in self._work:
            drawn = _blend([tensor[near] for tensor in cut], rows, columns)
            (drawn * grad_planes[:, rows, columns]).sum().backward()
        grads = [torch.zeros_like(t) if t.grad is None else t.grad for t in cut]
        inner = torch.autograd.grad(joints, list(self._leaves.values()), grads, retain_graph=True)
        result = {}
        for (name, shape), gradient in zip(self._shapes.items(), inner, strict=True):
            result[name] = torch.zeros(shape, dtype=torch.float64)
            result[name][self._seen] = gradient
        return result


def _window(camera: Camera, column: int, row: int) -> tuple[slice, slice]:
    top, left = row * TILE_PX, column * TILE_PX
    return slice(top, min(top + TILE_PX, camera.height)), slice(left, min(left + TILE_PX, camera.width))


def _hits(splats: Splats, column: int, row: int) -> Tensor:
    """Find the splats (N,) that may reach the tile: their boxes do, with a margin of a pixel."""
    middle = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64) * TILE_PX
    reach = splats.half_sizes + TILE_PX / 2 + 1
    return ((splats.centers - middle).abs() < reach).all(1) & (splats.values[:, 3] > NEAR_DEPTH)


def _alphas(splats: list[Tensor], rows: slice, columns: slice) -> Tensor:
    """Compute alphas (n, h, w), before any limit."""
    centers, precisions, opacities, _ = splats
    y = torch.arange(rows.start, rows.stop, dtype=torch.float64) + 0.5
    x = torch.arange(columns.start, columns.stop, dtype=torch.float64) + 0.5
    dx = (x - centers[:, :1])[:, None, :]
    dy = (y - centers[:, 1:])[:, :, None]
    xx, xy, yy = (column[:, None, None] for column in precisions.unbind(1))
    return opacities[:, None, None] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)


def _light(alphas: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute limited alphas, log(1 - alpha), and the light in front of every splat, all (n, h, w).

    The rule that drawing stops is not applied; once the light is below the limit it stays there, so
    the rule excludes exactly the splats with too little light in front of them.
    """
    limited = torch.where(alphas >= MIN_ALPHA, alphas.clamp_max(MAX_ALPHA), 0)
    kept = torch.log1p(-limited)
    return limited, kept, torch.exp(kept.cumsum(0) - kept)


def _blend(splats: list[Tensor], rows: slice, columns: slice) -> Tensor:
    """Blend the planes (5, h, w) of one window from its splats, near to far."""
    alphas, kept, light = _light(_alphas(splats, rows, columns))
    lit = light.detach() > MIN_TRANSMITTANCE
    weights = torch.where(lit, alphas * light, 0)
    alpha = 1 - torch.exp(torch.where(lit, kept, 0).sum(0))
    return torch.cat([torch.einsum("nhw,nc->chw", weights, splats[3]), alpha[None]])


def _decided(splats: list[Tensor], rows: slice, columns: slice) -> tuple[Tensor, int]:
    """Find pixels (h, w) far from every limit, and the number of blended pairs."""
    alphas = _alphas(splats, rows, columns)
    limited, _, light = _light(alphas)
    open_ = light > MIN_TRANSMITTANCE * (1 - NEAR_LIMIT)
    drawn = open_ & (limited > 0)
    at_limit = (alphas / MIN_ALPHA - 1).abs() < NEAR_LIMIT
    at_limit |= (light / MIN_TRANSMITTANCE - 1).abs() < NEAR_LIMIT
    unsure = (at_limit & open_).any(0)
    depths = splats[3][:, 3]
    tied = (depths[1:] - depths[:-1] < NEAR_TIE * depths[1:])[:, None, None]
    unsure |= (tied & drawn[1:] & drawn[:-1]).any(0)
    return ~unsure, int((drawn & (light > MIN_TRANSMITTANCE)).sum())
