"""Rejection of images that registered at a wrong pose: groups first, then single images.

A mapper accepts an image if enough of its matches are consistent. If several cartons have the same print, a wrong pose can have
enough consistent matches. Two-view geometry is additional evidence: at the true pose, nearly all verified matches of nearly all
pairs are consistent with the epipolar geometry of the poses; at a wrong pose, most pairs contradict it. A group of images at a
wrong pose is consistent within itself, so no single image of it is conspicuous. Evidence against the group are matches between it
and the other images that contradict the poses, and images that are close to each other by their poses but share no matches.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from aomgen.core.transforms import apply, invert, skew
from aomgen.core.values import Array
from aomgen.structure.mapping import Workspace
from aomgen.structure.sparse_model import Pair, SparseModel

# Repeated prints and weak texture cause false pairs with up to about this number of verified matches (measured: 15 to 33, where
# true neighbors have 40 to 500); only the matches beyond this number count as evidence.
FALSE_MATCHES = 35
# Least number of matches of a pair that is tested: COLMAP verifies a pair from 15 inliers on.
MIN_MATCHES = 15
# Largest epipolar error of a consistent match, [px]: the default of COLMAP's two-view geometry.
MAX_ERROR_PX = 4.0
# Least share of consistent matches of an image: the majority.
MIN_SHARE = 0.5
# Two images within these limits should share features: distance of their centers as a share of the depth, and angle between
# their viewing directions (SIFT tolerates about 30 degrees).
NEAR_SHARE = 0.2
# SIFT descriptors match reliably within this angle, [deg].
NEAR_ANGLE_DEG = 15.0
# Number of leading eigenvectors of the evidence that are tried as splits.
SPLITS = 6
# Largest motion of matches between two images of the same view, [px].
SAME_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class InlierModel:
    """A model and the images that were rejected from it.

    Attributes:
        dropped: Rejected images, with the reason.
        worst_agreement: Smallest share of matches that fit the pose, over the inlier images.
    """

    mapped: SparseModel
    dropped: dict[str, str]
    worst_agreement: float

    @property
    def count(self) -> int:
        """Number of inlier images."""
        return len(set(self.mapped.Ts_recon_cam) - set(self.dropped))


def is_better(new: InlierModel, old: InlierModel, max_error_px: float) -> bool:
    """Compare two models: within the error limit, more images, then less error."""
    first, second = (
        (item.mapped.error_px <= max_error_px, item.count, -item.mapped.error_px) for item in (new, old)
    )
    return first > second


def reject_outliers(work: Workspace, mapped: SparseModel) -> InlierModel:
    """Remove the images that the matches contradict from a model and map the rest again."""
    pairs = work.pairs("scan", mapped.lens)
    dropped: dict[str, str] = {}
    for group in find_wrong_groups(mapped.Ts_recon_cam, _depths(mapped), mapped.K, pairs):
        reason = (
            "misregistered: the other images contradict its pose"
            if len(group) == 1
            else f"misregistered: the other images contradict the poses of a group of {len(group)}"
        )
        dropped |= dict.fromkeys(group, reason)
    poses = {name: T for name, T in mapped.Ts_recon_cam.items() if name not in dropped}
    verdicts = check_registration(poses, mapped.K, pairs)
    dropped |= {name: reason for name, (_, reason) in verdicts.items() if reason}
    if dropped and len(dropped) < len(mapped.Ts_recon_cam):
        mapped = work.remap(mapped, set(dropped))
    shares = [share for share, reason in verdicts.values() if not reason]
    return InlierModel(mapped=mapped, dropped=dropped, worst_agreement=min(shares, default=0.0))


def _depths(mapped: SparseModel) -> dict[str, float]:
    depths = {}
    for name, T_recon_cam in mapped.Ts_recon_cam.items():
        points = np.unique(mapped.point_of_feature[name])
        points_cam = apply(invert(T_recon_cam), mapped.points_recon[points[points >= 0]])
        depths[name] = float(np.median(points_cam[:, 2])) if len(points_cam) else 0.0
    return depths


def find_wrong_groups(
    Ts_recon_cam: dict[str, Array], depths: dict[str, float], K: Array, pairs: list[Pair]
) -> list[set[str]]:
    """Find groups of images that the other images contradict more than they support; the larger side is kept.

    Args:
        Ts_recon_cam: Poses (4, 4) of the registered images by name.
        depths: Median depth of the points that an image shows, by image name.
        K: Intrinsics (3, 3), [px].
        pairs: Every pair that was matched, with its verified matches or with none.

    Not checked: a wrong group that shares no view with the other images and is not near them.
    """
    names = sorted(Ts_recon_cam)
    evidence = _evidence(names, Ts_recon_cam, depths, K, pairs)
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
    """Find images that show only the content of another image; return that image for each.

    Args:
        preferred: Images that are kept if two images are equal.
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


def _evidence(
    names: list[str], Ts_recon_cam: dict[str, Array], depths: dict[str, float], K: Array, pairs: list[Pair]
) -> Array:
    """Compute the evidence for each pair of poses, symmetric (N, N): supporting minus contradicting matches."""
    order = {name: index for index, name in enumerate(names)}
    known = [pair for pair in pairs if pair.a in order and pair.b in order]
    counts = np.zeros((len(names), len(names)))
    for pair in known:
        counts[order[pair.a], order[pair.b]] = counts[order[pair.b], order[pair.a]] = len(pair.pixels_a)
    # Every adjacent image is expected to have as many matches as the third best partner.
    usual = np.sort(counts, axis=1)[:, -3] if len(names) > 3 else np.zeros(len(names))
    evidence = np.zeros_like(counts)
    for pair in known:
        i, j, count = order[pair.a], order[pair.b], len(pair.pixels_a)
        T_a, T_b = Ts_recon_cam[pair.a], Ts_recon_cam[pair.b]
        if count >= MIN_MATCHES:
            errors = epipolar_errors_px(pair, T_a, T_b, K)
            share = float((errors <= MAX_ERROR_PX).mean())
            value = max(count - FALSE_MATCHES, 0) * (share - MIN_SHARE)
        elif _near(T_a, T_b, min(depths[pair.a], depths[pair.b])):
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
    """Find the split (N,) with the most evidence against its cut; None if all cuts are supported.

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


def epipolar_errors_px(pair: Pair, T_recon_a: Array, T_recon_b: Array, K: Array) -> Array:
    """Compute the Sampson distances (M,) of matched pixels under two poses, [px]."""
    T_b_a = np.linalg.inv(T_recon_b) @ T_recon_a
    K_inverse = np.linalg.inv(K)
    F = K_inverse.T @ skew(T_b_a[:3, 3]) @ T_b_a[:3, :3] @ K_inverse
    return np.sqrt(pycolmap.compute_squared_sampson_error(pair.pixels_a, pair.pixels_b, F))


def check_registration(
    Ts_recon_cam: dict[str, Array], K: Array, pairs: list[Pair], *, max_error_px: float = MAX_ERROR_PX
) -> dict[str, tuple[float, str]]:
    """Check every registered image by its verified matches with the accepted images.

    The worst image is dropped first, and the others are checked again without it, so that a wrong image does not reduce the
    scores of its neighbors.

    Args:
        pairs: Verified matches; pairs with unregistered images are ignored.
        max_error_px: Largest epipolar error of a consistent match, [px].

    Returns:
        By image name, the weighted share of its matches that fit the poses, 0..1, and the reason to drop the image; the
        reason is empty if at least half of the evidence supports the pose.

    Not checked: a group of images that is consistent within itself but wrong as a whole; the largest group is kept.
    """
    shares = {}
    for pair in pairs:
        if pair.a in Ts_recon_cam and pair.b in Ts_recon_cam and len(pair.pixels_a) >= MIN_MATCHES:
            errors = epipolar_errors_px(pair, Ts_recon_cam[pair.a], Ts_recon_cam[pair.b], K)
            shares[pair.a, pair.b] = (float((errors <= max_error_px).mean()), len(errors))
    verdicts: dict[str, tuple[float, str]] = {}
    alive = set(Ts_recon_cam)
    while alive:
        current = {name: _agreement(name, alive, shares) for name in sorted(alive)}
        worst = min(current, key=lambda name: current[name][0])
        if not current[worst][1]:
            return verdicts | current
        verdicts[worst] = current[worst]
        alive.remove(worst)
    return verdicts


def _agreement(
    name: str, alive: set[str], shares: dict[tuple[str, str], tuple[float, int]]
) -> tuple[float, str]:
    own = [
        value for (a, b), value in shares.items() if (a == name and b in alive) or (b == name and a in alive)
    ]
    if not own:
        return 0.0, f"no other image shares {MIN_MATCHES} verified matches with it"
    counts = np.array([count for _, count in own])
    weights = np.maximum(counts - FALSE_MATCHES, 0)
    if not weights.any():
        weights = counts
    mean = float(np.average([share for share, _ in own], weights=weights))
    if mean >= MIN_SHARE:
        return mean, ""
    return mean, f"misregistered: {mean:.0%} of its matches in {len(own)} pairs fit its pose"
