"""Detection of images that registered at a wrong pose.

A mapper accepts an image when enough of its matches agree with each other; with the same print on
several cartons a wrong place can gather enough. Two-view geometry is evidence the mapper did not
use up: at the true pose nearly all verified matches of nearly all pairs are consistent with the
epipolar geometry of the poses, at a wrong pose most pairs contradict it.
"""

from dataclasses import dataclass

import numpy as np

from aomgen.core.transforms import skew
from aomgen.core.values import Array

# Repeated prints and plain texture give false pairs of up to about this many "verified" matches
# (measured: 15 to 33 where true neighbours have 40 to 500); only what is above counts as evidence.
FALSE_MATCHES = 35
# Matches from which a pair is a test at all: COLMAP verifies a pair from 15 inliers on.
MIN_MATCHES = 15
# Epipolar error of a match that agrees, [px]: the default error of COLMAP's two-view geometry.
MAX_ERROR_PX = 4.0
# Share of its matches that must agree with an image: the majority.
MIN_SHARE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Verified matches of two images.

    Attributes:
        a, b: Image names.
        pixels_a, pixels_b: Matched pixels (M, 2).
    """

    a: str
    b: str
    pixels_a: Array
    pixels_b: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How well an image's pose fits its matches.

    Attributes:
        share: Weighted share of verified matches that fit the poses, 0..1.
        pairs: Pairs that had a say.
    """

    share: float
    pairs: int

    @property
    def accepted(self) -> bool:
        """At least half of the evidence supports the pose."""
        return self.pairs > 0 and self.share >= MIN_SHARE

    @property
    def reason(self) -> str:
        """One sentence for the report."""
        if not self.pairs:
            return f"no other image shares {MIN_MATCHES} verified matches with it"
        return f"misregistered: {self.share:.0%} of its matches in {self.pairs} pairs fit its pose"


def epipolar_errors_px(pair: Pair, T_recon_a: Array, T_recon_b: Array, K: Array) -> Array:
    """Sampson distance (M,) of matched pixels under two poses, [px].

    Source: Hartley & Zisserman, Multiple View Geometry, eq. 11.9.
    """
    T_b_a = np.linalg.inv(T_recon_b) @ T_recon_a
    K_inverse = np.linalg.inv(K)
    F = K_inverse.T @ skew(T_b_a[:3, 3]) @ T_b_a[:3, :3] @ K_inverse
    a = np.concatenate([pair.pixels_a, np.ones((len(pair.pixels_a), 1))], 1).astype(np.float64)
    b = np.concatenate([pair.pixels_b, np.ones((len(pair.pixels_b), 1))], 1).astype(np.float64)
    lines_b, lines_a = a @ F.T, b @ F
    numerator = np.abs((b * lines_b).sum(1))
    gradient = np.sqrt((lines_a[:, :2] ** 2).sum(1) + (lines_b[:, :2] ** 2).sum(1))
    return numerator / np.maximum(gradient, 1e-12)


def check_registration(Ts_recon_cam: dict[str, Array], K: Array, pairs: list[Pair]) -> dict[str, Agreement]:
    """Check every registered image by the verified matches it has with the accepted ones.

    The worst image is dropped first and the rest checked again without it, so that a wrong image
    does not drag its neighbours down.

    Args:
        Ts_recon_cam: Pose (4, 4) by image name.
        K: Intrinsics (3, 3), [px].
        pairs: Verified matches; pairs with unregistered images are ignored.

    Returns:
        Agreement by image name; those not `accepted` should be dropped.

    Not checked: a group of images that is wrong as a whole and agrees with itself; the largest
    group wins.
    """
    shares = {}
    for pair in pairs:
        if pair.a in Ts_recon_cam and pair.b in Ts_recon_cam and len(pair.pixels_a) >= MIN_MATCHES:
            errors = epipolar_errors_px(pair, Ts_recon_cam[pair.a], Ts_recon_cam[pair.b], K)
            shares[pair.a, pair.b] = (float((errors <= MAX_ERROR_PX).mean()), len(errors))
    verdicts: dict[str, Agreement] = {}
    alive = set(Ts_recon_cam)
    while alive:
        current = {name: _agreement(name, alive, shares) for name in sorted(alive)}
        worst = min(current, key=lambda name: current[name].share)
        if current[worst].accepted:
            return verdicts | current
        verdicts[worst] = current[worst]
        alive.remove(worst)
    return verdicts


def _agreement(name: str, alive: set[str], shares: dict[tuple[str, str], tuple[float, int]]) -> Agreement:
    own = [
        value for (a, b), value in shares.items() if (a == name and b in alive) or (b == name and a in alive)
    ]
    if not own:
        return Agreement(share=0.0, pairs=0)
    counts = np.array([count for _, count in own])
    weights = np.maximum(counts - FALSE_MATCHES, 0)
    if not weights.any():
        weights = counts
    return Agreement(share=float(np.average([share for share, _ in own], weights=weights)), pairs=len(own))
