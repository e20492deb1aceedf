"""Patches of a part that is pushed or pulled by the hand's surface without being held."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aomgen.core.values import Array
from aomgen.motion.grip_contact import SURFACE_SD_M, Patch

# A finger whose share of the touch is smaller than this does not touch.
_MIN_SHARE = 0.15
# Less travel than this has no direction, [m].
MIN_WAY_M = 5e-4
# Of the part, what is within this beside a point of the hand is in front of it, [m].
_BESIDE_M = SURFACE_SD_M
# What is met first is this thick by the noise of surfaces, [m].
_LAYER_M = 3 * SURFACE_SD_M
# What is met may seem to stand behind the hand's surface by as much as finger and alignment are off, [m].
_BEHIND_M = 0.012
# A surface whose normal is further from the way than this hardly pushes, cosine.
_MIN_FACING = 0.2


def find_push_patches(
    surface: tuple[Array, Array, NDArray[np.str_]], points_ee: Array, way_ee: Array
) -> tuple[Patch, ...]:
    """One patch on each finger that pushes the part.

    What the hand meets first on the way that the part goes is pushed: the bar and not the front behind
    the tips of a hook. It is pushed by what faces it and is nearest.

    Args:
        surface: Points (N, 3) and outward normals (N, 3) of the hand, end-effector frame, [m], and the
            finger of each (N,).
        points_ee: Dense points of the part (M, 3), same frame, [m].
        way_ee: Where the part goes during the first moments (3,), same frame, [m].

    Not checked: parts that bend within the width of the hand. Where hand and part are parallel, either end
    of the patch may carry the force.
    """
    points, normals, fingers = surface
    way = _direction(points, points_ee, way_ee)
    facing = np.clip(normals @ way, 0, 1)
    met, room_m = _met_first(points[facing > _MIN_FACING], points_ee, way)
    if not len(met):
        return ()
    # A hand is never inside the part.
    gaps = cKDTree(met).query(points + min(room_m, 0.0) * way)[0]
    nearest = float(gaps[facing > _MIN_FACING].min())
    weights = facing * np.exp(-0.5 * (np.maximum(gaps - nearest, 0) / SURFACE_SD_M) ** 2)
    weights /= weights.sum()
    patches = []
    for finger in np.unique(fingers):
        share = np.where(fingers == finger, weights, 0)
        if share.sum() >= _MIN_SHARE:
            gap = float(gaps[share > 0].min())
            patches.append(_patch(str(finger), (points, normals), share / share.sum(), gap))
    return tuple(patches)


def _direction(points: Array, points_ee: Array, way_ee: Array) -> Array:
    """Unit direction (3,) of the way, or towards the part where there is none."""
    length = float(np.linalg.norm(way_ee))
    if length > MIN_WAY_M:
        return way_ee / length
    distances, nearest = cKDTree(points_ee).query(points)
    first = int(np.argmin(distances))
    towards = points_ee[nearest[first]] - points[first]
    return towards / max(float(np.linalg.norm(towards)), 1e-9)


def _met_first(points: Array, points_ee: Array, way: Array) -> tuple[Array, float]:
    """What of the part (M, 3) points (N, 3) of a hand meet first (K, 3) if they go along `way`, and how soon, [m]."""
    across = np.linalg.svd(way[None])[2][1:]
    beside = cKDTree(points_ee @ across.T).query_ball_point(points @ across.T, _BESIDE_M)
    starts = np.repeat(points @ way, [len(near) for near in beside])
    found = np.array([index for near in beside for index in near], np.intp)
    room = points_ee[found] @ way - starts
    found, room = found[room > -_BEHIND_M], room[room > -_BEHIND_M]
    soonest = float(room.min(initial=np.inf))
    return points_ee[np.unique(found[room <= soonest + _LAYER_M])], soonest


def _patch(finger: str, surface: tuple[Array, Array], weights: Array, gap_m: float) -> Patch:
    points, normals = surface
    point, normal = weights @ points, weights @ normals
    spread = points - point
    covariance = (spread * weights[:, None]).T @ spread + (SURFACE_SD_M**2 + gap_m**2 / 3) * np.eye(3)
    length = max(float(np.linalg.norm(normal)), 1e-9)
    return Patch(finger=finger, point=point, normal=normal / length, covariance=covariance, gap_m=gap_m)
