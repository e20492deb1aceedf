"""Reconstruct Gaussians from photos alone, by the stages structure and gaussians without a capture."""

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.core.progress import Progress, part
from aomgen.core.project import Project
from aomgen.core.structure import Structure
from aomgen.errors import MissingFileError, ReconstructionError
from aomgen.gaussians.stage import METRICS_FILE, train_in
from aomgen.gaussians.train import GaussiansParams
from aomgen.gaussians.turntable import plan_turntable
from aomgen.importers.scan_formats import read_scan_source
from aomgen.importers.scan_writing import WrittenScan, write_scan
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.io.atomic import write_bytes
from aomgen.io.gaussian_files import write_gaussians
from aomgen.io.ply import read_gaussians
from aomgen.io.video import encode_video
from aomgen.pipeline.manifest import files_digest
from aomgen.pipeline.requirements import require_environment, require_room
from aomgen.pipeline.runner import Display, Stage, results_of, run_stages
from aomgen.results import GAUSSIANS_FILE, Results
from aomgen.splatting.rasterizer import render
from aomgen.structure.reconstruct import Photographs, StructureParams, reconstruct_structure
from aomgen.structure.stage import IMAGES_FOLDER, list_pose_warnings, write_undistorted

IMAGES: Final = "images"
# Default length of the longer side of the images, [px]; the Gaussians of a whole scene do not resolve finer details.
LONG_SIDE: Final = 960
# Largest number of SIFT features per image; the time of matching grows with its square, and images of the default size have
# few more features.
MAX_FEATURES: Final = 4096
# Frame rate and number of frames of the turntable video, which lasts 5 s.
VIDEO_FPS, VIDEO_FRAMES = 24, 120


def make_splat(
    source: Path, target: Path, display: Display, *, long_side: int = LONG_SIDE, video: Path | None = None
) -> str:
    """Reconstruct Gaussians from photos, a video or the scan of another program.

    Finished stages are kept in a folder next to the target (`scene.run` for `scene.ply`), where the same call continues.

    Args:
        source: See `read_scan_source`.
        target: PLY, SPLAT or USD file to be written; its frame is that of structure from motion, or of the source's poses.
        display: Receives the progress.
        long_side: Length of the longer side to which larger images are reduced, [px].
        video: MP4 file for a turntable video; None for no video.

    Returns:
        Numbers of images and Gaussians, and the mean PSNR and SSIM over the held-out images, in words.

    Raises:
        InputError: The source cannot be used.
        ReconstructionError: The scene cannot be reconstructed from the images.
        BackendError: A library is missing.
        StorageError: The results cannot be written, or another process uses the folder.
    """
    work = target.with_name(f"{target.stem}.run")
    if not source.exists():
        raise MissingFileError(source, "is missing", "give a folder of photos, or a video")
    require_room(work)
    require_environment(["structure", "gaussians"], "auto", has_masks=False)
    project = Project(capture=source.resolve(), out=work.resolve(), params={"scan": {"long_side": long_side}})
    run_stages(project, SPLAT_STAGES, display, inputs={"source": _digest_source(source, work)})
    results = results_of(project, SPLAT_STAGES)
    gaussians = read_gaussians(results.folders["gaussians"] / GAUSSIANS_FILE)
    write_gaussians(target, gaussians)
    if video is not None:
        write_bytes(video, encode_video(_render_turntable(results), VIDEO_FPS))
    metrics = read_json(results.folders["gaussians"] / METRICS_FILE)
    psnr_db, ssim = metrics["heldout_psnr"], metrics["heldout_ssim"]
    quality = "no held-out images, because there are too few images"
    if psnr_db is not None and ssim is not None:
        quality = f"held-out images: PSNR {psnr_db:.1f} dB, SSIM {ssim:.3f}"
    registered, dropped = len(results.structure.cameras_recon), len(results.structure.dropped)
    return f"{registered} of {registered + dropped} images, {len(gaussians)} Gaussians; {quality}"


def _digest_source(source: Path, work: Path) -> str:
    """Compute the digest of the files from which a source may be read."""
    if source.is_file() and source.suffix.lower() != ".json":
        return files_digest([source])
    folder = source if source.is_dir() else source.parent
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return files_digest([path for path in files if work.resolve() not in path.resolve().parents])


def _write_images(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run the stage "scan", which writes the images of the source at reduced size."""
    source = results.project.capture
    with tempfile.TemporaryDirectory() as scratch:
        found = read_scan_source(source, Path(scratch), part(progress, 0.0, 0.4))
        (folder / IMAGES).mkdir()
        long_side = results.project.params["scan"]["long_side"]
        written = write_scan(found, folder / IMAGES, long_side, source, part(progress, 0.4, 1.0))
    save_artifact(folder, "scan", written)
    return {"warnings": list(written.warnings)}


def _reconstruct(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run the stage "structure", which reconstructs cameras and sparse points."""
    scan = load_artifact(results.folders["scan"], "scan", WrittenScan)
    images = _list_images(results, scan)
    photographs = Photographs(
        images=images,
        intrinsics=scan.intrinsics,
        Ts_scan_cam=scan.poses.Ts_scan_cam if scan.poses else {},
    )
    found = reconstruct_scan(photographs, scan, part(progress, 0.0, 0.97))
    if found.scan_lens is not None:
        write_undistorted(images, found.scan_lens, folder, part(progress, 0.97, 1.0))
    save_artifact(folder, "structure", found)
    return {
        "registered": len(found.cameras_recon),
        "of": len(images),
        "reprojection_error_px": round(found.reprojection_error_px, 3),
        "points": len(found.points_recon),
        "warnings": list_pose_warnings(found),
    }


def reconstruct_scan(photographs: Photographs, scan: WrittenScan, progress: Progress) -> Structure:
    """Reconstruct a scan; for large images, features are first extracted without upsampling, and with it if this fails.

    Raises:
        ReconstructionError: The scene cannot be reconstructed from the images.
    """
    params = StructureParams(max_features=MAX_FEATURES)
    if max(scan.width, scan.height) >= LONG_SIDE:
        try:
            return reconstruct_structure(photographs, replace(params, first_octave=0), progress)
        except ReconstructionError as error:
            progress(0.0, f"again with finer features: {error.problem}")
    return reconstruct_structure(photographs, params, progress)


def _train(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run the stage "gaussians", which trains the scene."""
    scan = load_artifact(results.folders["scan"], "scan", WrittenScan)
    images = _list_images(results, scan)
    if results.structure.scan_lens is not None:
        images = {name: results.folders["structure"] / IMAGES_FOLDER / name for name in images}
    figures = train_in(folder, results.structure, images, progress, GaussiansParams())
    names = ("gaussians", "heldout_psnr", "heldout_ssim")
    return {name: figures[name] for name in names if figures[name] is not None}


def _list_images(results: Results, scan: WrittenScan) -> dict[str, Path]:
    return {name: results.folders["scan"] / IMAGES / name for name in scan.names}


def _render_turntable(results: Results) -> Iterator[NDArray[np.uint8]]:
    gaussians = read_gaussians(results.folders["gaussians"] / GAUSSIANS_FILE)
    cameras = list(results.structure.cameras_recon.values())
    # Sides of images are even, because videos store colors at half the resolution.
    width, height = (side // 2 * 2 for side in (cameras[0].width, cameras[0].height))
    for camera in plan_turntable(cameras, VIDEO_FRAMES):
        drawn = render(gaussians, camera.resize(width, height))
        yield np.clip(np.rint(drawn.rgb * 255), 0, 255).astype(np.uint8)


SPLAT_STAGES: Final = (
    Stage(
        name="scan",
        folder="scan",
        title="reading images",
        needs=("source",),
        version=1,
        weight=15,
        function=_write_images,
    ),
    Stage(
        name="structure",
        folder="structure",
        title="structure from motion",
        needs=("scan",),
        version=2,
        weight=60,
        function=_reconstruct,
        incremental=True,
    ),
    Stage(
        name="gaussians",
        folder="gaussians",
        title="training Gaussians",
        needs=("scan", "structure"),
        version=2,
        weight=120,
        function=_train,
        incremental=True,
    ),
)
