"""Camera poses and sparse points of the scan, with the fixed cameras in the same model.

Source: AOMGen, sec. 4.1; the mapper is COLMAP's (Schoenberger & Frahm, 2016). Our additions are the
choice of pairs, the decision about lens distortion (`lens_choice`), the search for misregistered images (`outlier_rejection`),
the choice between two mappers, the fixed cameras (`fixed_cameras`), and the limits of a valid reconstruction.
"""

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.progress import Progress
from aomgen.core.recording import Intrinsics, Prompt
from aomgen.core.structure import Figures, Structure
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.io.images import read_image
from aomgen.structure.fixed_cameras import DemoView, place_fixed_camera
from aomgen.structure.given_poses import PoseCheck, check_poses, map_from_poses
from aomgen.structure.lens_choice import choose_lens, fit_lens, lens_misfit_px, require_lens_fits
from aomgen.structure.mapping import Workspace
from aomgen.structure.outlier_rejection import InlierModel, duplicates, is_better, reject_outliers
from aomgen.structure.prompt_visibility import measure_prompt_visibility, require_coverage, undistort_prompts
from aomgen.structure.sparse_model import SparseModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Photographs:
    """Input images and prompts of the structure.

    Attributes:
        images: Scan images by file name; all of one size and one camera.
        prompts: In pixels of the images as recorded.
        Ts_scan_cam: Poses (4, 4) that are part of the scan, by image name; they may be wrong or missing.
    """

    images: dict[str, Path]
    intrinsics: Intrinsics | None = None
    demo: dict[str, DemoView] = field(default_factory=dict)
    prompts: tuple[Prompt, ...] = ()
    Ts_scan_cam: dict[str, Array] = field(default_factory=dict)


# Number of images beyond which only neighbors and a coarse grid are matched, because the number of pairs grows quadratically.
EXHAUSTIVE_LIMIT = 90
# Least number of different images of a scan.
MIN_IMAGES = 8
# Least share of the different scan images that must be registered; with fewer, sides of the scene are missing.
MIN_REGISTERED = 0.8
# Share of registered images below which a second mapper is tried as well.
RETRY_BELOW = 0.95
# Largest mean reprojection error of a valid reconstruction, [px]; SIFT locates features to about half a
# pixel.
MAX_ERROR_PX = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureParams:
    """Limits and effort of the reconstruction.

    Attributes:
        max_features: Largest number of SIFT features of an image.
        first_octave: Scale of the finest features: -1 doubles the images first, which finds about four times as many
            features in four times the time; 0 does not.
        threads: -1 = all cores.
    """

    max_features: int = 8192
    first_octave: int = -1
    seed: int = 0
    threads: int = -1


def reconstruct_structure(photographs: Photographs, params: StructureParams, progress: Progress) -> Structure:
    """Recover the cameras of a scan, and the fixed cameras in the same frame.

    Returns:
        The structure, without misregistered images.

    Raises:
        ReconstructionError: Too few images, too few of them registered, too large an error, a
            prompted part that the scan does not cover, or a fixed camera that cannot be registered.

    Not checked: rolling shutter; a lens that changes between the images (zoom, focus).
    """
    names = sorted(photographs.images)
    _require_images(len(names), 0)
    with tempfile.TemporaryDirectory(prefix="aomgen-structure-") as folder:
        work = Workspace(folder=Path(folder), seed=params.seed, threads=params.threads)
        _extract(work, photographs, params, progress)
        progress(0.25, "matching features")
        work.match(EXHAUSTIVE_LIMIT)
        prompted = {prompt.image for prompt in photographs.prompts}
        same = duplicates(work.pairs("scan", work.lens("scan")), prompted)
        _require_images(len(names), len(same))
        work.leave_out("scan", set(same))
        known = {name: T for name, T in photographs.Ts_scan_cam.items() if name in names and name not in same}
        given = check_poses(work, known) if known else None
        inliers, figures = _solve(work, photographs.intrinsics, len(names) - len(same), given, progress)
        progress(0.99, "placing the fixed cameras")
        placed = {
            name: place_fixed_camera(work, inliers.mapped, name, view, photographs.intrinsics)
            for name, view in photographs.demo.items()
        }
    dropped = inliers.dropped | {name: f"shows the same as {other}" for name, other in same.items()}
    structure = _structure(names, replace(inliers, dropped=dropped), placed, figures)
    return _check_coverage(structure, photographs.prompts)


def _require_images(count: int, repeated: int) -> None:
    if not count - repeated >= MIN_IMAGES:
        again = f", {repeated} of them twice" if repeated else ""
        raise ReconstructionError(
            "scan",
            f"has {count} images{again}, at least {MIN_IMAGES} are needed",
            "record more images from more viewpoints",
        )


def _extract(work: Workspace, photographs: Photographs, params: StructureParams, progress: Progress) -> None:
    images = photographs.images
    scan = ((name, read_image(images[name])) for name in sorted(images))
    progress(0.0, "finding features")
    effort = params.max_features, params.first_octave
    work.extract("scan", scan, photographs.intrinsics, *effort)
    for index, (name, view) in enumerate(photographs.demo.items(), 1):
        progress(0.2 * index / (1 + len(photographs.demo)), "finding features")
        stills = [("first", view.first_srgb), ("median", view.median_srgb)]
        work.extract(f"demo:{name}", stills, view.intrinsics, *effort)


def _solve(
    work: Workspace, intrinsics: Intrinsics | None, count: int, given: PoseCheck | None, progress: Progress
) -> tuple[InlierModel, Figures]:
    """Map from given poses, incrementally and globally; return the first model that has nearly all images, else the best.

    Raises:
        ReconstructionError: No model satisfies the limits.
    """
    progress(0.75, "mapping")
    attempts: dict[str, tuple[InlierModel, Figures]] = {}
    mappers = {"incremental": work.map, "global": work.map_globally}
    if given is not None and given.usable:
        mappers = {"given poses": lambda group: map_from_poses(work, given.Ts_scan_cam)} | mappers
    for mapper, run in mappers.items():
        mapped, lens_figures = _map(work, run, intrinsics)
        if mapped is not None:
            progress(0.97, "checking every image")
            attempts[mapper] = reject_outliers(work, mapped), lens_figures
            if attempts[mapper][0].count >= RETRY_BELOW * count:
                break
        progress(0.97, "mapping by the other method")
    if not attempts:
        raise ReconstructionError(
            "scan", "no two images could be matched", "record with more overlap and texture"
        )
    names = list(attempts)
    best = names[0]
    for other in names[1:]:
        if is_better(attempts[other][0], attempts[best][0], MAX_ERROR_PX):
            best = other
    inliers, lens_figures = attempts[best]
    _gate(count, inliers)
    tried = {
        name: {"registered": item.count, "reprojection_error_px": item.mapped.error_px}
        for name, (item, _) in attempts.items()
    }
    figures: Figures = {"mapper": best, "tried": tried, "lens": lens_figures}
    if given is not None:
        figures["given_poses"] = {
            "used": len(given.Ts_scan_cam) if best == "given poses" else 0,
            "contradicted": given.contradicted,
            "warnings": list(given.describe()),
        }
    return inliers, figures


def _map(
    work: Workspace, run: Callable[[str], SparseModel | None], intrinsics: Intrinsics | None
) -> tuple[SparseModel | None, Figures]:
    """Map the scan with its stated lens, then adjust it with the one that the matches call for."""
    mapped = run("scan")
    if mapped is None:
        return None, {}
    choice = choose_lens(work.model, intrinsics, seed=work.seed)
    lens = choice.lens
    if work.set_lens("scan", lens):
        run("scan")
        lens = fit_lens(work.model, choice.model, intrinsics, seed=work.seed)
        work.set_lens("scan", lens)
    misfit_px = lens_misfit_px(work.model)
    require_lens_fits(misfit_px, "scan")
    return work.read_model("scan"), {**asdict(choice), **asdict(lens), "misfit_px": misfit_px}


def _gate(count: int, inliers: InlierModel) -> None:
    share = inliers.count / count
    if not share >= MIN_REGISTERED:
        raise ReconstructionError(
            "scan",
            f"{inliers.count} of {count} images could be registered "
            f"({len(inliers.dropped)} contradicted their neighbours), "
            f"at least {MIN_REGISTERED:.0%} are needed",
            "record with more overlap, more texture and fewer repeated prints",
        )
    if not inliers.mapped.error_px <= MAX_ERROR_PX:
        raise ReconstructionError(
            "scan",
            f"reprojection error is {inliers.mapped.error_px:.2f} px, limit {MAX_ERROR_PX:.2f} px",
            "check the intrinsics, lens distortion and motion blur",
        )


def _structure(
    names: list[str], inliers: InlierModel, placed: dict[str, tuple[Camera, Lens, Figures]], figures: Figures
) -> Structure:
    mapped = inliers.mapped
    lens = mapped.lens
    cameras = {
        name: lens.pinhole_camera(mapped.Ts_recon_cam[name]) for name in names if name in mapped.Ts_recon_cam
    }
    dropped = {
        name: inliers.dropped.get(name, "not registered: too few matches to the other images")
        for name in names
        if name not in cameras
    }
    order = {name: index for index, name in enumerate(cameras)}
    observations = [(p, order[name]) for p, name in mapped.observations]
    return Structure(
        cameras_recon=cameras,
        demo_cameras_recon={name: camera for name, (camera, _, _) in placed.items()},
        scan_lens=lens if lens.bends else None,
        demo_lenses={name: bent for name, (_, bent, _) in placed.items() if bent.bends},
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
            "worst_agreement": inliers.worst_agreement,
            "largest_shift_px": lens.largest_shift_px(),
            "demo_cameras": {name: measured for name, (_, _, measured) in placed.items()},
        }
        | figures,
    )


def _check_coverage(structure: Structure, prompts: tuple[Prompt, ...]) -> Structure:
    """Add the visibility of every prompt to the metrics of the structure.

    Raises:
        ReconstructionError: A prompted part is not covered.
    """
    if structure.scan_lens is not None:
        prompts = undistort_prompts(prompts, structure.scan_lens)
    found = measure_prompt_visibility(
        prompts, structure.cameras_recon, structure.points_recon, structure.observations
    )
    require_coverage(found)
    return replace(structure, figures=structure.figures | {"prompts": [asdict(item) for item in found]})
