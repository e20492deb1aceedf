"""Light that the links of an asset block from each other and from themselves, over the joint's range."""

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

# Joint values, as shares of the range.
STATES: Final = (0.0, 0.5, 1.0)
# Occlusion is computed at every THINNED-th disc and averaged over the NEAR closest of these, where a
# difference of direction counts as this distance, [m].
THINNED, NEAR, ALIKE_M = 2, 8, 0.2
# Surfaces open to less than this share of the sky in every state are hidden:
# faces of a gap, interior surfaces.
CLOSED: Final = 0.02


def estimate_link_transfer(
    asset: ArticulatedAsset,
    covers: Sequence[Surfels],
    solids: Sequence[Array],
    means: NDArray[np.float32],
    normals: NDArray[np.float32],
    links: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Estimate the transfer (N, 9), see `core.light`, of points on an asset's links, as mean over the range.

    Enclosed surfaces are invisible, so joint values at which a disc is open to the sky have more weight. A
    point gets the mean of nearby discs with a similar normal: a single disc is as noisy as the cells in which
    its occlusion was computed.

    Args:
        covers: Discs on the static and on the moving link, link frame.
        solids: Dense points (M, 3) of each.
        means, normals: The points (N, 3) and their unit normals, frame of their link.
        links: Link of each point (N,), 0 or 1.
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
