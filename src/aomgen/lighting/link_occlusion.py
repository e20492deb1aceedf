"""Estimate the light that the links of an asset block from each other and from themselves, over the joint's range."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.lighting.visibility import Occluders, estimate_transfer
from aomgen.splatting.surfels import Surfels

# Joint values at which occlusion is computed, as shares of the upper limit.
STATES: Final = (0.0, 0.5, 1.0)
# Occlusion is computed at every THINNED-th disc and averaged over the NEAR closest of these discs; a unit difference of the
# normals counts as the distance ALIKE_M, [m].
THINNED, NEAR, ALIKE_M = 2, 8, 0.2
# Surfaces to which less than this share of the sky is visible in every state are hidden, for example in gaps.
CLOSED: Final = 0.02


def estimate_link_transfer(
    asset: ArticulatedAsset,
    covers: Sequence[Surfels],
    solids: Sequence[Array],
    means: NDArray[np.float32],
    normals: NDArray[np.float32],
    links: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Estimate the transfer (N, 9), see `core.light`, of points on an asset's links, as a mean over the joint's range.

    Joint values at which a larger share of the sky is visible have more weight, because enclosed surfaces are invisible. Each
    point gets the mean of nearby discs with similar normals, because the occlusion of a single disc has the discretization
    noise of the cells.

    Args:
        asset: Asset with a static and a moving link.
        covers: Discs on the static and on the moving link, link frame.
        solids: Dense points (M, 3) on each link.
        means, normals: Points (N, 3) and their unit normals (N, 3), frame of their link.
        links: Link of each point (N,), 0 for static, 1 for moving.
    """
    motions = [asset.joint.motion(share * asset.joint.upper) for share in STATES]
    result = np.zeros((len(means), 9), np.float32)
    for k, cover in enumerate(covers):
        points, facing = (
            part[::THINNED].astype(np.float64) for part in (cover.gaussians.means, cover.normals)
        )
        transfers, shares = [], []
        for motion in motions:
            other = apply(motion if k == 0 else invert(motion), solids[1 - k])
            occluders = Occluders(np.concatenate([solids[k], other]))
            transfer, seen = estimate_transfer(points, facing, occluders)
            transfers.append(transfer)
            shares.append(seen)
        opened = np.array(shares) + 1e-9
        outer = opened.max(0) > CLOSED
        outer |= not outer.any()
        transfer = np.einsum("sn,snk->nk", opened / opened.sum(0), np.array(transfers))[outer]
        known = np.column_stack([points[outer], ALIKE_M * facing[outer]])
        mine = links == k
        wanted = np.column_stack([means[mine], ALIKE_M * normals[mine]])
        _, near = cKDTree(known).query(wanted, k=min(NEAR, len(known)))
        result[mine] = transfer[near].mean(1)
    return result
