"""Fixed cameras in the scan's model: placed twice, from the first frame and from the median."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.recording import Intrinsics
from aomgen.errors import ReconstructionError
from aomgen.structure.mapping import Workspace
from aomgen.structure.resection import (
    Resection,
    choose_view_lens,
    difference,
    resect,
)
from aomgen.structure.sparse_model import SparseModel

STILLS = ("first", "median")
# Two placements of one camera are the same place below these; a wrong place is far beyond. Where
# both are right they differ by 0.01 to 0.1 degrees and 0.1 % of the depth.
SAME_ANGLE_DEG = 2.0
# The same for the distance, as share of the depth.
SAME_DISTANCE_SHARE = 0.03
# Of two places the better one is believed with this many times the matches of the other.
CLEAR_MAJORITY = 2.0
# Matches in one corner leave a camera free to swing about them.
MIN_SPREAD = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoView:
    """Images of a fixed camera: its first frame and the temporal median of its video.

    Attributes:
        first_srgb: (H, W, 3) uint8, robot as in the scan.
        median_srgb: (H, W, 3) uint8, most of the moving arm gone.
        intrinsics: Stated intrinsics, a prior, or None.
    """

    first_srgb: NDArray[np.uint8]
    median_srgb: NDArray[np.uint8]
    intrinsics: Intrinsics | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedCamera:
    """A placed camera.

    Attributes:
        camera_recon: Optics of its undistorted frames, and pose.
        lens: Its optics as photographed.
        figures: What was found and which still is used (JSON values).
    """

    camera_recon: Camera
    lens: Lens
    figures: dict[str, object]


def place_fixed_camera(
    work: Workspace, mapped: SparseModel, name: str, view: DemoView, scan_intrinsics: Intrinsics | None
) -> PlacedCamera:
    """Find a fixed camera and its lens.

    A camera with the scan's image size and statement, or with none, may be the one that scanned.

    Raises:
        ReconstructionError: Neither still can be placed, or they contradict each other and
            neither is clearly better.
    """
    group = f"demo:{name}"
    stated, lens = view.intrinsics, work.lens(group)
    focal_known = stated is not None
    found = _to_fixed_camera(work, mapped, group, lens, focal_known=focal_known)
    figures: dict[str, object] = {}
    if found:
        still, best = max(found.items(), key=lambda item: item[1].count)
        same = (lens.width, lens.height) == (mapped.lens.width, mapped.lens.height)
        scan_lens = mapped.lens if same and stated in (None, scan_intrinsics) else None
        links = work.links(group, (still,), mapped)
        choice = choose_view_lens(links, best, stated, scan_lens, seed=work.seed)
        figures |= {"lens": choice.model, "lens_gain": choice.gain, "lens_significance": choice.significance}
        lens, focal_known = choice.lens, True
        work.set_lens(group, lens)
        found = _to_fixed_camera(work, mapped, group, lens, focal_known=True)
    used, reason = _choose(name, found)
    best = found[used[0]]
    if len(used) == 2:
        best = resect(work.links(group, used, mapped), lens, focal_known=focal_known, seed=work.seed) or best
    camera = best.camera_recon
    figures |= {f"{still}_inliers": placed.count for still, placed in found.items()}
    figures |= {"used": list(used), "reason": reason}
    if len(found) == 2:
        angle_deg, share = difference(found["first"], found["median"])
        figures |= {"disagreement_deg": angle_deg, "disagreement_share": share}
    return PlacedCamera(camera_recon=camera, lens=lens, figures=figures)


def _to_fixed_camera(
    work: Workspace, mapped: SparseModel, group: str, lens: Lens, *, focal_known: bool
) -> dict[str, Resection]:
    found = {
        still: resect(work.links(group, (still,), mapped), lens, focal_known=focal_known, seed=work.seed)
        for still in STILLS
    }
    return {still: placed for still, placed in found.items() if placed is not None}


def _choose(name: str, found: dict[str, Resection]) -> tuple[tuple[str, ...], str]:
    """Choose the stills to use, with the reason.

    Raises:
        ReconstructionError: None can be used.
    """
    where = f"demo camera {name!r}"
    remedy = "scan from nearby this camera, so that its view is covered"
    held = {still: placed for still, placed in found.items() if placed.spread >= MIN_SPREAD}
    if not held:
        problem = (
            f"is placed only by matches in {max(p.spread for p in found.values()):.0%} of its image, "
            f"at least {MIN_SPREAD:.0%} are needed"
            if found
            else "cannot be placed in the scan's model, neither by its first frame nor by its temporal median"
        )
        raise ReconstructionError(where, problem, remedy)
    if len(held) == 1:
        return tuple(held), "the other still could not be placed"
    first, median = held["first"], held["median"]
    angle_deg, share = difference(first, median)
    if angle_deg <= SAME_ANGLE_DEG and share <= SAME_DISTANCE_SHARE:
        return STILLS, "first frame and temporal median agree"
    more, fewer = ("first", "median") if first.count >= median.count else ("median", "first")
    if not held[more].count >= CLEAR_MAJORITY * held[fewer].count:
        raise ReconstructionError(
            where,
            f"first frame and temporal median place it {angle_deg:.1f} deg and "
            f"{share:.0%} of its distance apart, with {first.count} and {median.count} "
            "matches, so neither can be trusted",
            f"check that the camera did not move; {remedy}",
        )
    return (more,), f"they disagree, and it has {held[more].count} matches against {held[fewer].count}"
