"""Camera poses and sparse points of the scan, with the fixed cameras in the same model.

Source: AOMGen, sec. 4.1; the mapper is COLMAP's (Schoenberger & Frahm, 2016). What is ours: the
choice of pairs, the search for misregistered images (`consistency`), and the fixed cameras
(`resection`).
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.core.camera import Camera
from aomgen.core.progress import Progress
from aomgen.core.values import Array, freeze
from aomgen.errors import ReconstructionError
from aomgen.io.images import read_image
from aomgen.reconstruction.consistency import Agreement, misregistered
from aomgen.reconstruction.mapping import ImageSet, Workspace
from aomgen.reconstruction.resection import Resection, agree, resect

Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoView:
    """What a fixed camera shows: its first frame and the temporal median of its video.

    Attributes:
        first_srgb: (H, W, 3) uint8, robot as in the scan.
        median_srgb: (H, W, 3) uint8, most of the moving arm gone.
        intrinsics: [fx, fy, cx, cy] in px, or None to estimate the focal length.
    """

    first_srgb: NDArray[np.uint8]
    median_srgb: NDArray[np.uint8]
    intrinsics: Intrinsics | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureParams:
    """Limits and effort.

    Attributes:
        max_features: SIFT features kept an image.
        peak_threshold: SIFT contrast threshold; half of COLMAP's default, for plain surfaces.
        exhaustive_limit: With more images than this only neighbours and a coarse grid are matched.
        min_registered: Share of scan images that must survive.
        max_error_px: Mean reprojection error that still counts as a reconstruction.
        seed: Of every random choice.
        threads: -1 = all cores.
    """

    max_features: int = 8192
    peak_threshold: float = 0.0035
    exhaustive_limit: int = 90
    min_registered: float = 0.8
    max_error_px: float = 1.5
    seed: int = 0
    threads: int = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """A sparse model of the scene in the `recon` frame (no scale, no gravity).

    Attributes:
        cameras_recon: Registered scan images by file name, in name order.
        demo_cameras_recon: Fixed cameras by name.
        dropped: Scan images that are not in the model, with the reason.
        points_recon: Points (P, 3).
        colors_srgb: Colors (P, 3) uint8.
        observations: (M, 2) int32, rows of (point, index into `cameras_recon` in order).
        reprojection_error_px: Mean over all observations, [px].
        figures: Measured numbers for the manifest (JSON values).
    """

    cameras_recon: dict[str, Camera]
    demo_cameras_recon: dict[str, Camera]
    dropped: dict[str, str]
    points_recon: Array
    colors_srgb: NDArray[np.uint8]
    observations: NDArray[np.int32]
    reprojection_error_px: float
    figures: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.points_recon)
        freeze(self, "points_recon", self.points_recon, (count, 3))
        freeze(self, "colors_srgb", self.colors_srgb, (count, 3), np.uint8)
        freeze(self, "observations", self.observations, (None, 2), np.int32)


def reconstruct_structure(
    images: dict[str, Path],
    intrinsics: Intrinsics | None,
    demo: dict[str, DemoView],
    params: StructureParams,
    progress: Progress,
) -> Structure:
    """Recover the cameras of a scan, and the fixed cameras in the same frame.

    Args:
        images: Scan images by file name; all of one size and one camera.
        intrinsics: [fx, fy, cx, cy] in px, kept as given; None estimates one focal length.
        demo: Fixed cameras by name.
        params: Limits and effort.
        progress: Share done and a few words.

    Returns:
        The structure; misregistered images are dropped, never averaged in.

    Raises:
        ReconstructionError: Too few images, too few of them registered, too large an error, or a
            fixed camera that cannot be placed.

    Not checked: lens distortion (a pinhole is assumed), rolling shutter.
    """
    names = sorted(images)
    if not len(names) >= 8:
        raise ReconstructionError(
            "scan", f"has {len(names)} images, at least 8 are needed", "record more images"
        )
    with tempfile.TemporaryDirectory(prefix="aomgen-structure-") as folder:
        work = Workspace(folder=Path(folder), seed=params.seed, threads=params.threads)
        _extract(work, images, intrinsics, demo, params, progress)
        progress(0.25, "matching features")
        work.match(params.exhaustive_limit)
        progress(0.6, "mapping")
        mapped = work.map("scan")
        if mapped is None:
            raise ReconstructionError(
                "scan", "no two images could be related", "record with more overlap and texture"
            )
        progress(0.85, "checking every image")
        verdicts = misregistered(mapped.Ts_recon_cam, mapped.K, work.pairs("scan"))
        bad = {name: v for name, v in verdicts.items() if not v.accepted}
        if bad:
            mapped = work.remap(mapped, set(bad))
        _gate(names, set(mapped.Ts_recon_cam), bad, mapped.error_px, params)
        progress(0.92, "placing the fixed cameras")
        placed = {name: _place(work, mapped, name, view) for name, view in demo.items()}
    return _structure(names, mapped, placed, verdicts, images)


def _extract(
    work: Workspace,
    images: dict[str, Path],
    intrinsics: Intrinsics | None,
    demo: dict[str, DemoView],
    params: StructureParams,
    progress: Progress,
) -> None:
    scan = ((name, read_image(images[name])) for name in sorted(images))
    sets = [ImageSet(group="scan", images=scan, intrinsics=intrinsics)]
    for name, view in demo.items():
        stills = iter([("first", view.first_srgb), ("median", view.median_srgb)])
        sets.append(ImageSet(group=f"demo:{name}", images=stills, intrinsics=view.intrinsics))
    for index, item in enumerate(sets):
        progress(0.2 * index / len(sets), "finding features")
        work.extract(item, params.max_features, params.peak_threshold)


def _gate(
    names: list[str],
    registered: set[str],
    bad: dict[str, Agreement],
    error_px: float,
    params: StructureParams,
) -> None:
    share = len(registered) / len(names)
    if not share >= params.min_registered:
        raise ReconstructionError(
            "scan",
            f"{len(registered)} of {len(names)} images could be registered "
            f"({len(bad)} contradicted their neighbours), at least {params.min_registered:.0%} are needed",
            "record with more overlap, more texture and fewer repeated prints",
        )
    if not error_px <= params.max_error_px:
        raise ReconstructionError(
            "scan",
            f"reprojection error is {error_px:.2f} px, limit {params.max_error_px:.2f} px",
            "check the intrinsics, lens distortion and motion blur",
        )


def _place(work: Workspace, mapped, name: str, view: DemoView) -> tuple[Camera, dict[str, object]]:
    """Fixed camera from its first frame, compared with its temporal median."""
    found = {
        still: resect(
            work.links(f"demo:{name}", still, mapped),
            view.intrinsics,
            (image.shape[1], image.shape[0]),
            work.seed,
        )
        for still, image in (("first", view.first_srgb), ("median", view.median_srgb))
    }
    good: dict[str, Resection] = {still: r for still, r in found.items() if r is not None}
    if not good:
        raise ReconstructionError(
            f"demo camera {name!r}",
            "cannot be placed in the scan's model, neither by its first frame nor by its temporal median",
            "scan from nearby this camera, or give its pose as T_world_cam",
        )
    best = good.get("first") or good["median"]
    figures: dict[str, object] = {f"{still}_inliers": r.inliers for still, r in good.items()}
    if len(good) == 2:
        apart = agree(good["first"], good["median"])
        figures |= {"disagreement_deg": apart.angle_deg, "disagreement_share": apart.distance_share}
        if not (apart.angle_deg <= 2.0 and apart.distance_share <= 0.03):
            best = max(good.values(), key=lambda r: r.inliers)
            figures["disagree"] = True
    return best.camera_recon, figures


def _structure(names, mapped, placed, verdicts: dict[str, Agreement], images: dict[str, Path]) -> Structure:
    size = read_image(images[names[0]]).shape[1::-1]
    fx, fy, cx, cy = mapped.K[0, 0], mapped.K[1, 1], mapped.K[0, 2], mapped.K[1, 2]
    cameras = {
        name: Camera(
            fx=fx, fy=fy, cx=cx, cy=cy, width=size[0], height=size[1], T_world_cam=mapped.Ts_recon_cam[name]
        )
        for name in names
        if name in mapped.Ts_recon_cam
    }
    dropped = {}
    for name in names:
        if name not in cameras:
            verdict = verdicts.get(name)
            dropped[name] = (
                verdict.reason if verdict else "not registered: too few matches to the other images"
            )
    order = {name: index for index, name in enumerate(cameras)}
    observations = [(p, order[name]) for p, name in mapped.observations]
    return Structure(
        cameras_recon=cameras,
        demo_cameras_recon={name: camera for name, (camera, _) in placed.items()},
        dropped=dropped,
        points_recon=mapped.points_recon,
        colors_srgb=mapped.colors_srgb,
        observations=np.array(observations, np.int32).reshape(-1, 2),
        reprojection_error_px=mapped.error_px,
        figures={
            "registered": len(cameras),
            "images": len(names),
            "points": len(mapped.points_recon),
            "reprojection_error_px": mapped.error_px,
            "worst_agreement": min((v.share for n, v in verdicts.items() if n in cameras), default=0.0),
            "demo_cameras": {name: figures for name, (_, figures) in placed.items()},
        },
    )
