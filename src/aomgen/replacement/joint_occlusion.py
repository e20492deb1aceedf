"""Light that the links of an asset block from each other and from themselves, over the joint's range."""

from collections.abc import Sequence
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.splatting.surfaces import estimate_transfer
from aomgen.splatting.surfels import Surfels

# Joint values, as shares of the range.
STATES: Final = (0.0, 0.5, 1.0)
# Occlusion is computed at every THINNED-th disc, and is a mean over NEAR of these, among which another direction
# counts as this distance, [m].
THINNED, NEAR, ALIKE_M = 2, 8, 0.2
# Surfaces open to less than this share of the sky in every state are hidden: faces of a gap, insides of bodies.
CLOSED: Final = 0.02


class Occlusion(NamedTuple):
    """Transfer (N, 9), see `core.light`, of places on a link that look along unit normals (N, 3)."""

    points: Annotated[Array, "N 3"]
    normals: Annotated[Array, "N 3"]
    transfer: Annotated[Array, "N 9"]

    def at(self, points: NDArray, normals: NDArray) -> NDArray[np.float32]:
        """Transfer (M, 9) of other places: the mean of those near by that look the same way.

        A single one's is as rough as the cells in which its occlusion was found.
        """
        places = np.column_stack([self.points, ALIKE_M * self.normals])
        _, near = cKDTree(places).query(
            np.column_stack([points, ALIKE_M * normals]), k=min(NEAR, len(places))
        )
        return self.transfer[near].mean(1).astype(np.float32)


def find_occlusion(
    asset: ArticulatedAsset, links: Sequence[Surfels], solids: Sequence[Array]
) -> list[Occlusion]:
    """Occlusion of the static and the moving link, discs and dense points (M, 3) of each, own frame.

    What is closed in is not seen: of several joint values those count more at which a disc is open to the sky.
    """
    motions = [asset.joint.motion(share * asset.joint.upper) for share in STATES]
    found = []
    for k, link in enumerate(links):
        points, normals = (
            part[::THINNED].astype(np.float64) for part in (link.gaussians.means, link.normals)
        )
        transfers, shares = [], []
        for motion in motions:
            other = apply(motion if k == 0 else invert(motion), solids[1 - k])
            transfer, seen = estimate_transfer(points, normals, np.concatenate([solids[k], other]))
            transfers.append(transfer)
            shares.append(seen)
        opened = np.array(shares) + 1e-9
        outer = opened.max(0) > CLOSED
        outer |= not outer.any()
        transfer = np.einsum("sn,snk->nk", opened / opened.sum(0), np.array(transfers))
        found.append(Occlusion(points[outer], normals[outer], transfer[outer]))
    return found
