"""Patches of a part that is pushed or pulled by the hand's surface without being held."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.values import Array
from aomgen.motion.grip import SURFACE_SD_M, Patch

# A finger whose share of the touch is smaller than this does not touch.
_MIN_SHARE = 0.15
# Less travel than this has no direction, [m].
_MIN_WAY_M = 5e-4


def pushing_patches(
    surface: tuple[Array, Array, NDArray[np.str_]], points_ee: Array, way_ee: Array
) -> tuple[Patch, ...]:
    """One patch on each finger that pushes the part.

    A finger pushes along its own normal, so of all that is near the part only what faces the way that
    the part goes can move it: the inside of a hook and not its back, the knuckle and not the palm beside.

    Args:
        surface: Points (N, 3) and outward normals (N, 3) of the hand, end-effector frame, [m], and the
            finger of each (N,).
        points_ee: Dense points of the part (M, 3), same frame, [m].
        way_ee: Where the hand goes during the first moments (3,), same frame, [m].
    """
    points, normals, fingers = surface
    length = float(np.linalg.norm(way_ee))
    facing = np.clip(normals @ way_ee / length, 0, 1) if length > _MIN_WAY_M else np.ones(len(points))
    distances = cKDTree(points_ee).query(points)[0]
    nearest = float(distances[facing > 0.5].min(initial=np.inf))
    if not np.isfinite(nearest):
        return ()
    weights = facing * np.exp(-0.5 * np.maximum(distances**2 - nearest**2, 0) / SURFACE_SD_M**2)
    weights /= weights.sum()
    patches = []
    for finger in np.unique(fingers):
        share = np.where(fingers == finger, weights, 0)
        if share.sum() >= _MIN_SHARE:
            patches.append(_patch(str(finger), points, normals, share / share.sum(), distances))
    return tuple(patches)


def _patch(finger: str, points: Array, normals: Array, weights: Array, distances: Array) -> Patch:
    point, normal = weights @ points, weights @ normals
    spread = points - point
    gap = float(distances[weights > 0].min())
    covariance = (spread * weights[:, None]).T @ spread + (SURFACE_SD_M**2 + gap**2 / 3) * np.eye(3)
    length = max(float(np.linalg.norm(normal)), 1e-9)
    return Patch(finger=finger, point=point, normal=normal / length, covariance=covariance, gap_m=gap)
