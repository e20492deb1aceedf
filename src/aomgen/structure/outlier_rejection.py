"""Rejection of misregistered images: groups first, then every image by itself."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.transforms import apply, invert
from aomgen.structure.clusters import Views, wrong_groups
from aomgen.structure.mapping import Workspace
from aomgen.structure.misregistration import check_registration
from aomgen.structure.sparse_model import SparseModel


@dataclass(frozen=True, kw_only=True)
class InlierModel:
    """A model and the images that were rejected from it.

    Attributes:
        mapped: The model.
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
    views = Views(Ts_recon_cam=mapped.Ts_recon_cam, depths=_depths(mapped), K=mapped.K)
    dropped: dict[str, str] = {}
    for group in wrong_groups(views, pairs):
        reason = (
            "misregistered: the other images contradict its pose"
            if len(group) == 1
            else f"misregistered: the other images contradict the poses of a group of {len(group)}"
        )
        dropped |= dict.fromkeys(group, reason)
    poses = {name: T for name, T in mapped.Ts_recon_cam.items() if name not in dropped}
    verdicts = check_registration(poses, mapped.K, pairs)
    dropped |= {name: verdict.reason for name, verdict in verdicts.items() if not verdict.accepted}
    if dropped and len(dropped) < len(mapped.Ts_recon_cam):
        mapped = work.remap(mapped, set(dropped))
    shares = [verdict.share for verdict in verdicts.values() if verdict.accepted]
    return InlierModel(mapped=mapped, dropped=dropped, worst_agreement=min(shares, default=0.0))


def _depths(mapped: SparseModel) -> dict[str, float]:
    depths = {}
    for name, T_recon_cam in mapped.Ts_recon_cam.items():
        points = np.unique(mapped.point_of_feature[name])
        points_cam = apply(invert(T_recon_cam), mapped.points_recon[points[points >= 0]])
        depths[name] = float(np.median(points_cam[:, 2])) if len(points_cam) else 0.0
    return depths
