"""Cover of an asset's links by lit discs, in seconds instead of the minute of a fit, for images of a few hundred pixels."""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.values import Array
from aomgen.lighting.link_occlusion import estimate_link_transfer
from aomgen.lighting.visibility import Occluders, turn_outward
from aomgen.splatting.surfels import Surfels, hiding_points, surfels_of

# Points on each link that occlude light.
POINTS: Final = 100_000
# Discs on each link of an asset that is not fitted to images, about one for each pixel of an image that is 256 pixels wide;
# candidates for each disc; and discs to which light is traced.
DISCS, OVERSAMPLING, COARSE = 14_000, 2.0, 1800
# A difference of direction between two discs counts as this distance, [m].
ALIKE_M: Final = 0.2


def cover_links(
    asset: ArticulatedAsset, discs: int, rng: np.random.Generator
) -> tuple[list[Surfels], list[Array]]:
    """Cover an asset's static and moving link with about `discs` discs each, and sample dense points (M, 3) on both.

    Raises:
        AssetError: A link has no surface.
    """
    meshes = (asset.static.meshes, asset.moving.meshes)
    solids = [hiding_points(items, POINTS, rng) for items in meshes]
    covers = [surfels_of(items, discs, rng) for items in meshes]
    return [_turn_outward(cover, solid) for cover, solid in zip(covers, solids, strict=True)], solids


def cover_asset(asset: ArticulatedAsset, rng: np.random.Generator) -> tuple[tuple[Surfels, Surfels], ...]:
    """Cover an asset's static and moving link with fine discs that include their light transfer, and with coarse discs.

    Light is traced to the coarse discs; the transfer of the fine discs is interpolated from their neighbors.

    Raises:
        AssetError: A link has no surface.
    """
    meshes = (asset.static.meshes, asset.moving.meshes)
    drawn = [surfels_of(items, COARSE, rng) for items in meshes]
    solids = [hiding_points(items, POINTS, rng) for items in meshes]
    coarse = [_turn_outward(cover, solid) for cover, solid in zip(drawn, solids, strict=True)]
    fine = [
        _turn_like(surfels_of(items, DISCS, rng, OVERSAMPLING), before, after)
        for items, before, after in zip(meshes, drawn, coarse, strict=True)
    ]
    means, normals = (
        np.concatenate(parts)
        for parts in zip(*((cover.gaussians.means, cover.normals) for cover in fine), strict=True)
    )
    count = len(fine[0].gaussians)
    links = np.repeat([0, 1], [count, len(means) - count])
    transfers = np.split(estimate_link_transfer(asset, coarse, solids, means, normals, links), [count])
    static, moving = (
        replace(cover, transfer=transfer) for cover, transfer in zip(fine, transfers, strict=True)
    )
    return (static, moving), (coarse[0], coarse[1])


def _turn_like(cover: Surfels, before: Surfels, after: Surfels) -> Surfels:
    """Turn the normals of a cover as those of the nearest discs of another cover of the same meshes were turned."""

    def places(discs: Surfels) -> Array:
        return np.column_stack([discs.gaussians.means, ALIKE_M * discs.normals]).astype(np.float64)

    turned = (before.normals * after.normals).sum(1) < 0
    _, nearest = cKDTree(places(before)).query(places(cover))
    return replace(cover, normals=np.where(turned[nearest, None], -cover.normals, cover.normals))


def _turn_outward(cover: Surfels, surface: Array) -> Surfels:
    means, normals = (part.astype(np.float64) for part in (cover.gaussians.means, cover.normals))
    return replace(cover, normals=turn_outward(means, normals, Occluders(surface)).astype(np.float32))
