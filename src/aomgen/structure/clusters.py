"""Detection of groups of images that are misregistered as a whole, and images that show nothing new.

A group at a wrong place agrees with itself, so that no image of it stands out alone. Between such
a group and the rest there is evidence against it: verified matches that contradict the poses, and
images that stand side by side by their poses and yet have nothing in common.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.values import Array
from aomgen.structure.misregistration import (
    FALSE_MATCHES,
    MAX_ERROR_PX,
    MIN_MATCHES,
    MIN_SHARE,
    Pair,
    epipolar_errors_px,
)

# Two images this near are seen by a feature from the same side (SIFT holds to about 30 degrees):
# distance of their centres as a share of the depth, and angle between their viewing directions.
NEAR_SHARE = 0.2
# SIFT descriptors match reliably within this angle, [deg].
NEAR_ANGLE_DEG = 15.0
# Candidate splits: leading eigenvectors of the evidence.
SPLITS = 6
# Matches that moved no farther than this come from the same place, [px].
SAME_PX = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Views:
    """Poses of the registered images.

    Attributes:
        Ts_recon_cam: Pose (4, 4) by image name.
        depths: Median depth of the points that an image shows, by image name.
        K: Intrinsics (3, 3), [px].
    """

    Ts_recon_cam: dict[str, Array]
    depths: dict[str, float]
    K: Array


def wrong_groups(views: Views, pairs: list[Pair]) -> list[set[str]]:
    """Groups of images that the rest contradicts more than it supports; the larger side is kept.

    Args:
        views: Registered images.
        pairs: Every pair that was tried, with its verified matches or with none.

    Not checked: a wrong group that shares no view with the rest, nor stands where the rest stands.
    """
    names = sorted(views.Ts_recon_cam)
    evidence = _evidence(names, views, pairs)
    alive = np.ones(len(names), bool)
    groups = []
    while True:
        rows = np.flatnonzero(alive)
        split = _worst_split(evidence[np.ix_(rows, rows)])
        if split is None:
            return groups
        smaller = split if split.sum() * 2 <= len(split) else ~split
        groups.append({names[row] for row in rows[smaller]})
        alive[rows[smaller]] = False


def duplicates(pairs: list[Pair], preferred: set[str]) -> dict[str, str]:
    """Images that show nothing but what another one shows, and that other one.

    Args:
        pairs: Verified matches.
        preferred: Of two equal images one of these stays.
    """
    found: dict[str, str] = {}
    for pair in sorted(pairs, key=lambda pair: (pair.a, pair.b)):
        if pair.a in found or pair.b in found or len(pair.pixels_a) <= FALSE_MATCHES:
            continue
        moved = np.linalg.norm(pair.pixels_a - pair.pixels_b, axis=1)
        if np.percentile(moved, 90) <= SAME_PX:
            first, second = sorted((pair.a, pair.b))
            if second in preferred and first not in preferred:
                first, second = second, first
            found[second] = first
    return found


def _evidence(names: list[str], views: Views, pairs: list[Pair]) -> Array:
    """Symmetric (N, N): matches in favor of two images' poses, less those against them."""
    order = {name: index for index, name in enumerate(names)}
    known = [pair for pair in pairs if pair.a in order and pair.b in order]
    counts = np.zeros((len(names), len(names)))
    for pair in known:
        counts[order[pair.a], order[pair.b]] = counts[order[pair.b], order[pair.a]] = len(pair.pixels_a)
    # What an image shares with its third best partner: what it should share with one beside it.
    usual = np.sort(counts, axis=1)[:, -3] if len(names) > 3 else np.zeros(len(names))
    evidence = np.zeros_like(counts)
    for pair in known:
        i, j, count = order[pair.a], order[pair.b], len(pair.pixels_a)
        T_a, T_b = views.Ts_recon_cam[pair.a], views.Ts_recon_cam[pair.b]
        if count >= MIN_MATCHES:
            errors = epipolar_errors_px(pair, T_a, T_b, views.K)
            share = float((errors <= MAX_ERROR_PX).mean())
            value = max(count - FALSE_MATCHES, 0) * (share - MIN_SHARE)
        elif _near(T_a, T_b, min(views.depths[pair.a], views.depths[pair.b])):
            value = -MIN_SHARE * max(0.5 * min(usual[i], usual[j]) - FALSE_MATCHES, 0)
        else:
            value = 0.0
        evidence[i, j] = evidence[j, i] = value
    return evidence


def _near(T_recon_a: Array, T_recon_b: Array, depth: float) -> bool:
    cosine = float(T_recon_a[:3, 2] @ T_recon_b[:3, 2])
    distance = float(np.linalg.norm(T_recon_a[:3, 3] - T_recon_b[:3, 3]))
    return distance <= NEAR_SHARE * depth and cosine >= np.cos(np.radians(NEAR_ANGLE_DEG))


def _worst_split(evidence: Array) -> NDArray[np.bool_] | None:
    """The split (N,) with most evidence against its cut, or None when all cuts are supported.

    Source: the leading eigenvectors solve the relaxed problem max s^T E s over s = +-1 (as for
    modularity, Newman 2006, doi:10.1073/pnas.0601602103); single images are then moved to the side
    that supports them.
    """
    if len(evidence) < 2:
        return None
    _, vectors = np.linalg.eigh(evidence)
    best, worst = None, 0.0
    for vector in vectors[:, ::-1][:, :SPLITS].T:
        side = _converge_signs(evidence, np.where(vector >= 0, 1.0, -1.0))
        cut = float(evidence[np.ix_(side > 0, side < 0)].sum())
        if cut < worst:
            best, worst = side > 0, cut
    return best


def _converge_signs(evidence: Array, side: Array) -> Array:
    for _ in range(4 * len(side)):
        gain = side * (evidence @ side)
        move = int(np.argmin(gain))
        if gain[move] >= 0:
            break
        side = side.copy()
        side[move] = -side[move]
    return side
