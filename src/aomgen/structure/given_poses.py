"""Model from poses that are part of the scan: they are checked against the matches, points are triangulated, all is adjusted.

Source: triangulation with known poses as in COLMAP (Schoenberger & Frahm, 2016). The check of the poses and the
two rounds of triangulation are ours: poses of phones have errors of about a degree, so the first round accepts larger
reprojection errors than the second.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from aomgen.core.values import Array
from aomgen.structure.mapping import Workspace
from aomgen.structure.outlier_rejection import check_registration
from aomgen.structure.sparse_model import SparseModel

# Largest rotational error of a usable pose, [deg]: the drift of a phone's odometry is smaller.
MAX_POSE_ERROR_DEG: Final = 1.0
# With a smaller share of usable poses the images are mapped as if no poses were known.
MIN_USED_SHARE: Final = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseCheck:
    """Given poses that the matches support, and those that they contradict.

    Attributes:
        Ts_scan_cam: Supported poses (4, 4) by image name.
        contradicted: Reasons by image name.
    """

    Ts_scan_cam: dict[str, Array]
    contradicted: dict[str, str]

    @property
    def usable(self) -> bool:
        """Return whether enough poses are supported for a start."""
        given = len(self.Ts_scan_cam) + len(self.contradicted)
        return len(self.Ts_scan_cam) > 1 and len(self.Ts_scan_cam) >= MIN_USED_SHARE * given

    def describe(self) -> tuple[str, ...]:
        """Describe the given poses that are not used as warnings."""
        if not self.contradicted:
            return ()
        names = sorted(self.contradicted)
        given = len(self.Ts_scan_cam) + len(names)
        listed = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        instead = "these images are registered" if self.usable else "all images are mapped"
        return (
            f"the matches contradict {len(names)} of {given} poses of scan_poses.json ({listed}); "
            f"{instead} without them",
        )


def check_poses(work: Workspace, Ts_scan_cam: dict[str, Array]) -> PoseCheck:
    """Compare given poses with the verified matches of the scan."""
    lens = work.lens("scan")
    K = lens.pinhole_camera(np.eye(4)).K
    limit_px = np.tan(np.radians(MAX_POSE_ERROR_DEG)) * K[0, 0]
    verdicts = check_registration(Ts_scan_cam, K, work.pairs("scan", lens), max_error_px=limit_px)
    return PoseCheck(
        Ts_scan_cam={name: T for name, T in Ts_scan_cam.items() if not verdicts[name][1]},
        contradicted={name: reason for name, (_, reason) in verdicts.items() if reason},
    )


def map_from_poses(work: Workspace, Ts_scan_cam: dict[str, Array]) -> SparseModel | None:
    """Triangulate and adjust the images with poses, then register the others incrementally."""
    lens = work.lens("scan")
    work.place("scan", Ts_scan_cam)
    for error_deg in (MAX_POSE_ERROR_DEG, 0.0):
        work.triangulate(np.tan(np.radians(error_deg)) * lens.fx)
    return work.extend_model("scan")
