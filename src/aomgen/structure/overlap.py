"""Measure which scan images see the same surfaces, and from where, by a match of small images."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from aomgen.conventions import linear_from_srgb
from aomgen.core.values import Array, freeze_arrays
from aomgen.core.walk import describe_walk
from aomgen.structure.mapping import Workspace
from aomgen.structure.outlier_rejection import duplicates
from aomgen.structure.sparse_model import Pair

# Number of features of an image: 64 images take about ten seconds on two cores.
MAX_FEATURES: Final = 512
# All pairs are matched up to this number of images; in longer scans only neighbors and a coarse grid.
EXHAUSTIVE_LIMIT: Final = 70
# Two images overlap if geometry confirms this number of matches, as in COLMAP's mapper.
MIN_MATCHES: Final = 15
# A surface is reconstructed from three views.
MIN_PARTNERS: Final = 2
# Difference of exposure that is reported, [EV]: half an aperture stop; with a locked exposure, phones stay within 0.1.
MAX_EXPOSURE_EV: Final = 0.5
# Range of the pixels that are used for exposure, [gray levels].
DARK, BRIGHT = 12.0, 243.0
# Number of sweeps over all images, after which the exposures have converged.
SWEEPS: Final = 10
# Least share of the images in a quick reconstruction that determines the walk.
ENOUGH_MAPPED: Final = 0.9
# Least number of images of a walk around an object.
MIN_WALK: Final = 3
# Largest number of names in one sentence.
SHOWN_NAMES = 5
# Predicate of a warning about each kind of problem, and the remedy.
SENTENCES: Final = {
    "isolated": ("overlap with no image of the others", "they will be dropped; record images in between"),
    "weakly connected": ("overlap with one other image only", "record images beside them"),
    "exposed otherwise": (
        "are brighter or darker than the images that overlap with them",
        "lock exposure and white balance",
    ),
    "repeated": ("show the same as another one", "they add nothing"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanOverlap:
    """Overlap of the images of a scan.

    Attributes:
        names: N names.
        matches: (N, N) confirmed matches of each pair, symmetric.
        exposures_ev: (N,) brightness of the same surfaces against that in the other images, [EV].
        repeated: Images that show only the content of another image, and that image.
        Ts_recon_cam: Approximate poses (4, 4) of the images that a quick reconstruction contains, by name.
    """

    names: tuple[str, ...]
    matches: Annotated[NDArray[np.int32], "N N"]
    exposures_ev: Annotated[Array, "N"]
    repeated: dict[str, str]
    Ts_recon_cam: dict[str, Array]

    __post_init__ = freeze_arrays

    @property
    def partners(self) -> NDArray[np.int64]:
        """(N,) number of images that each one overlaps with."""
        return (self.matches >= MIN_MATCHES).sum(1)

    @property
    def problems(self) -> dict[str, NDArray[np.bool_]]:
        """Masks (N,) of the images with each kind of problem."""
        isolated = self.isolated
        return {
            "isolated": isolated,
            "weakly connected": ~isolated & (self.partners < MIN_PARTNERS),
            "exposed otherwise": np.abs(self.exposures_ev) > MAX_EXPOSURE_EV,
            "repeated": np.isin(self.names, list(self.repeated)),
        }

    @property
    def isolated(self) -> NDArray[np.bool_]:
        """Mask (N,) of the images that are not connected to the largest group of overlapping images."""
        _, groups = connected_components(self.matches >= MIN_MATCHES, directed=False)
        return groups != np.bincount(groups).argmax()

    def describe_walk(self) -> str:
        """Return a sentence about the directions from which the scene was recorded."""
        names = list(self.Ts_recon_cam)
        if len(names) < MIN_WALK:
            return f"{len(names)} of {len(self.names)} images in a quick reconstruction, too few to show the walk"
        gap_rad, before, after = describe_walk(list(self.Ts_recon_cam.values())).find_gap()
        return (
            f"{len(names)} of {len(self.names)} images in a quick reconstruction; the widest sector without images is "
            f"{np.degrees(gap_rad):.0f} degrees, between {names[before]} and {names[after]}"
        )

    def list_warnings(self) -> list[str]:
        """Return a sentence for each kind of problem that some images have."""
        return [
            f"{which.sum()} of {len(self.names)} scan images {SENTENCES[kind][0]} ({self._list_names(which)}): "
            f"{SENTENCES[kind][1]}"
            for kind, which in self.problems.items()
            if which.any()
        ]

    def _list_names(self, which: NDArray[np.bool_]) -> str:
        names = [name for name, chosen in zip(self.names, which, strict=True) if chosen]
        more = f", {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
        return ", ".join(names[:SHOWN_NAMES]) + more


def measure_overlap(images: Mapping[str, NDArray[np.float32]]) -> ScanOverlap:
    """Match small copies of a scan's images.

    Args:
        images: Gray levels (H, W) by name, all of one size, see `scan_images.read_grey`.

    Returns:
        Confirmed matches of each pair, and approximate poses; unmatched pairs of a long scan have 0 matches.

    Not checked: wrong matches; a mirror or a repeated pattern connects images as well.
    """
    names, greys = tuple(images), list(images.values())
    with tempfile.TemporaryDirectory(prefix="aomgen-overlap-") as folder:
        work = Workspace(folder=Path(folder), seed=0, threads=-1)
        colored = (np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2) for grey in greys)
        items = iter(zip(names, colored, strict=True))
        work.extract("scan", items, None, MAX_FEATURES)
        work.match(EXHAUSTIVE_LIMIT)
        pairs = work.pairs("scan", work.lens("scan"))
        Ts_recon_cam = _map_quickly(work, len(names))
    order = {name: index for index, name in enumerate(names)}
    matches = np.zeros((len(names), len(names)), np.int32)
    ratios = np.full(matches.shape, np.nan)
    for pair in pairs:
        a, b = order[pair.a], order[pair.b]
        matches[a, b] = matches[b, a] = len(pair.pixels_a)
        if len(pair.pixels_a) >= MIN_MATCHES:
            ratios[a, b] = _compare_exposures(pair, greys[a], greys[b])
            ratios[b, a] = -ratios[a, b]
    return ScanOverlap(
        names=names,
        matches=matches,
        exposures_ev=_solve_exposures(ratios),
        repeated=duplicates(pairs, set()),
        Ts_recon_cam=Ts_recon_cam,
    )


def _map_quickly(work: Workspace, count: int) -> dict[str, Array]:
    """Estimate poses by incremental mapping, and by the slower global mapping if features join too few images."""
    # An unsuccessful mapping is stated by `describe_walk`; the next workspace logs errors again.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    found: dict[str, Array] = {}
    for run in (work.map, work.map_globally):
        mapped = run("scan")
        if mapped is not None and len(mapped.Ts_recon_cam) > len(found):
            found = dict(sorted(mapped.Ts_recon_cam.items()))
        if len(found) >= ENOUGH_MAPPED * count:
            break
    return found


def _solve_exposures(ratios_ev: Array) -> Array:
    """Compute the exposures (N,) that explain the ratios (N, N) of pairs, NaN for unknown ratios; the median exposure is 0.

    Each image in turn takes the median of the values that its pairs imply: coordinate descent on the sum of absolute errors.
    """
    exposures = np.zeros(len(ratios_ev))
    for _ in range(SWEEPS):
        for image, known in enumerate(np.isfinite(ratios_ev)):
            if known.any():
                exposures[image] = np.median(ratios_ev[image, known] + exposures[known])
        exposures -= np.median(exposures)
    return exposures


def _compare_exposures(pair: Pair, grey_a: NDArray[np.float32], grey_b: NDArray[np.float32]) -> float:
    """Compare the brightness of the matched surfaces, first image over second, median, [EV]; 0 where all are clipped."""
    seen = []
    for grey, pixels in ((grey_a, pair.pixels_a), (grey_b, pair.pixels_b)):
        height, width = grey.shape
        columns, rows = np.clip(pixels.astype(int), 0, [width - 1, height - 1]).T
        seen.append(grey[rows, columns])
    usable = np.all([(values > DARK) & (values < BRIGHT) for values in seen], axis=0)
    if not usable.any():
        return 0.0
    bright_a, bright_b = (linear_from_srgb(values[usable] / 255.0) for values in seen)
    return float(np.median(np.log2(bright_a / bright_b)))
