"""New surface where the old object stood, which goes over into the old surface without a border.

A picture from above has no gloss, and trained surfaces look different from every side. What they have beside the picture
is continued smoothly; then both surfaces fade into each other.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.core.transforms import apply, quat_from_matrix
from aomgen.core.values import Array
from aomgen.replacement.inpainting import continue_smoothly
from aomgen.twin.plan_view import PlanView

# Over so much one surface fades into the other, [m].
FADE: Final = 0.05
# New surface lies this far below the old one, so that the old covers it where it is sound, [m].
BELOW: Final = 0.0015
# Standard deviation and thickness of a cell's Gaussian, in cells, and its opacity.
SPREAD, THICKNESS, OPACITY = 0.8, 0.1, 0.98
# The old surface has no gaps where it covers so much.
SOUND: Final = 0.6


def renew_surface(
    old: Gaussians,
    table: NDArray[np.bool_],
    plan: PlanView,
    texture: Array,
    known: NDArray[np.bool_],
    new: NDArray[np.bool_],
    closed: NDArray[np.bool_],
    area: NDArray[np.bool_],
) -> tuple[Gaussians, NDArray[np.float32]]:
    """Flat Gaussians, one a cell, and the share (N,) of their opacity that the old ones keep.

    Args:
        old: All that is there, world frame.
        table: Which of it (N,) is the surface.
        plan: The surface from above.
        texture: Its picture, 0..1.
        known: Where that was photographed.
        new: Where nothing of the old surface shall stay.
        closed: Where gaps in it are closed too.
        area: Where it is, and no flat thing lies on it.
    """
    sh = old.sh[table].reshape(int(table.sum()), -1)
    around, cover = plan.mean(old.select(table), sh)
    sound = cover >= SOUND
    # Harmonics that the trained surface has beside its picture.
    around[..., :3] -= (texture - 0.5) / SH_C0
    looks = continue_smoothly(around, known & sound).reshape(*plan.shape, -1, 3)
    filled = area & (new | (closed & ~sound))
    beyond = np.asarray(distance_transform_edt(~filled)) * plan.cell
    fill = _flat(plan, texture, looks, np.clip(2 - 2 * beyond / FADE, 0, 1) * area)
    # Feet of things on the surface, which are neither known nor new, stay.
    kept = np.where(known | new, np.clip(2 * beyond / FADE, 0, 1), 1.0)
    return fill, np.where(table, plan.lookup(kept, old, 1.0), 1.0).astype(np.float32)


def _flat(plan: PlanView, texture: Array, looks: Array, opacity: Array) -> Gaussians:
    where = opacity > 0
    count, T = int(where.sum()), plan.support.T_world_plane
    sh = looks[where]
    sh[:, 0] += (texture[where] - 0.5) / SH_C0
    side = SPREAD * plan.cell
    return gaussians_of(
        means=apply(T, np.column_stack([plan.xy[where], np.full(count, -BELOW)])),
        quats=np.broadcast_to(quat_from_matrix(T[:3, :3]), (count, 4)),
        scales=np.broadcast_to([side, side, THICKNESS * plan.cell], (count, 3)),
        opacities=OPACITY * opacity[where],
        sh=sh,
    )
