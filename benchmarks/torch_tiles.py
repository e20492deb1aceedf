"""A tile rasterizer in plain torch operations for comparison with the engine: float32, autograd backward."""

import torch
from torch import Tensor

from aomgen.core.camera import Camera
from benchmarks.projection import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR_DEPTH, Splats, project


def render(parameters: dict[str, Tensor], camera: Camera, degree: int, *, tile_px: int = 16) -> Tensor:
    """Render planes (5, H, W) over black: red, green, blue, depth (not divided by alpha), alpha.

    The function projects all Gaussians at once, sorts the visible ones by depth, finds the pairs of tiles and
    splats whose boxes intersect, and blends every tile by cumulative products over its pairs.

    Args:
        parameters: Tensors by the names in `PARAMETERS`, float32.
        camera: View in the frame of the means.
        degree: Spherical harmonics that are evaluated, 0..3.
        tile_px: Side of a square tile, [px].
    """
    splats = project(parameters, camera, degree)
    with torch.no_grad():
        order = _visible_near_to_far(splats, camera)
        begin, pairs = _tile_pairs(splats, order, camera, tile_px)
    rows = []
    columns = -(-camera.width // tile_px)
    for top in range(0, camera.height, tile_px):
        row = []
        for left in range(0, camera.width, tile_px):
            tile = top // tile_px * columns + left // tile_px
            which = pairs[begin[tile] : begin[tile + 1]]
            tensors = [tensor[which] for tensor in splats.differentiable()]
            bottom, right = min(top + tile_px, camera.height), min(left + tile_px, camera.width)
            row.append(_blend(tensors, (top, bottom), (left, right)))
        rows.append(torch.cat(row, 2))
    return torch.cat(rows, 1)


def _visible_near_to_far(splats: Splats, camera: Camera) -> Tensor:
    size = torch.tensor([camera.width, camera.height], dtype=torch.float32)
    meets = (splats.centers > -splats.half_sizes) & (splats.centers < size + splats.half_sizes)
    visible = meets.all(1) & (splats.values[:, 3] > NEAR_DEPTH) & (splats.half_sizes[:, 0] > 0)
    indices = visible.nonzero()[:, 0]
    return indices[torch.argsort(splats.values[indices, 3], stable=True)]


def _tile_pairs(splats: Splats, order: Tensor, camera: Camera, tile_px: int) -> tuple[list[int], Tensor]:
    """Find the start of every tile's pairs (tiles + 1), and the pairs' splats, near to far in every tile."""
    columns, rows = -(-camera.width // tile_px), -(-camera.height // tile_px)
    last = torch.tensor([columns - 1, rows - 1], dtype=torch.float32)
    centers, half = splats.centers[order], splats.half_sizes[order]
    first_tile = ((centers - half) / tile_px).floor().clamp_min(0).minimum(last).long()
    last_tile = ((centers + half) / tile_px).floor().clamp_min(0).minimum(last).long()
    spans = last_tile - first_tile + 1
    counts = spans.prod(1)
    owner = torch.repeat_interleave(torch.arange(len(order)), counts)
    number = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    column = first_tile[owner, 0] + number % spans[owner, 0]
    row = first_tile[owner, 1] + number // spans[owner, 0]
    tile, by_tile = torch.sort(row * columns + column, stable=True)
    begin = torch.searchsorted(tile, torch.arange(columns * rows + 1))
    return begin.tolist(), order[owner[by_tile]]


def _blend(splats: list[Tensor], rows: tuple[int, int], columns: tuple[int, int]) -> Tensor:
    centers, precisions, opacities, values = splats
    dx = (torch.arange(*columns) + 0.5 - centers[:, :1])[:, None, :]
    dy = (torch.arange(*rows) + 0.5 - centers[:, 1:])[:, :, None]
    xx, xy, yy = (column[:, None, None] for column in precisions.unbind(1))
    exponents = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alphas = (opacities[:, None, None] * exponents.exp()).clamp_max(MAX_ALPHA)
    alphas = alphas * (alphas.detach() >= MIN_ALPHA)
    after = (1 - alphas).cumprod(0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = alphas * before * (before.detach() > MIN_TRANSMITTANCE)
    drawn = torch.einsum("nhw,nc->chw", weights, values)
    return torch.cat([drawn, weights.sum(0, keepdim=True)])
