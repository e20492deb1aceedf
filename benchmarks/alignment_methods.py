"""The paper's rigid ICP and link boxes beside our outlines, on a finished run."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from aomgen.core.camera import camera_in_world
from aomgen.core.recording import Capture
from aomgen.gaussians.stage import load_gaussians
from aomgen.motion.stage import load_motion
from aomgen.paper.link_boxes import bodies_in_boxes
from aomgen.parts.label import find_parts, part_evidence, segment_scan
from aomgen.parts.prompted_images import segment_prompts
from aomgen.parts.stage import scan_views
from aomgen.pipeline.aligning import align_by_paper
from aomgen.pipeline.stages import STAGES
from aomgen.pipeline.twin_stages import posture_of, scanned_twin
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.structure.stage import load_structure
from aomgen.twin.twin import Twin
from benchmarks.table import as_table

PREFIX = "paper."
# What the two methods are compared in.
GROUPS = ("alignment.", "cameras.median", "demo_camera.", "parts.", "images.replay")


def paper_twin(out: Path, capture: Capture, estimates: dict[str, Any]) -> tuple[Twin, dict[str, Any], float]:
    """The twin that a finished run would have with the paper's alignment and link boxes.

    Args:
        out: Folder of the run, finished up to its twin.
        capture: What the run works on, see `working_capture`.
        estimates: Of the run.

    Returns:
        The twin; the estimates with similarity and cameras of the paper's alignment, clock and
        motion left as they are; and the seconds that the alignment took.

    Raises:
        AlignmentError, ReconstructionError: The method has no answer.
    """
    folders = {stage.name: out / stage.folder for stage in STAGES}
    structure, posture = load_structure(folders["structure"]), posture_of(capture)
    images = {path.name: path for path in capture.scan_images}
    gaussians_recon = load_gaussians(folders["gaussians"]).gaussians_recon
    started = time.monotonic()
    S_world_recon = align_by_paper(capture, structure, gaussians_recon).S_world_recon
    seconds = time.monotonic() - started
    world = gaussians_recon.transformed(S_world_recon)
    views = scan_views(structure, S_world_recon, images, posture)
    segmenter = choose_segmenter(capture.mask_folders)
    prompted = segment_prompts(views, capture.prompts, segmenter)
    scan = segment_scan(world, views, bodies_in_boxes(world.means, posture), prompted)
    parts = find_parts(scan, part_evidence(scan))
    joint = load_motion(folders["motion"]).joint
    return (
        scanned_twin(world, parts, joint, posture),
        _with_alignment(estimates, structure.cameras_recon, structure.demo_cameras_recon, S_world_recon),
        seconds,
    )


def _with_alignment(
    estimates: dict[str, Any], cameras_recon: dict, demo_cameras_recon: dict, S_world_recon: np.ndarray
) -> dict[str, Any]:
    def poses(cameras: dict) -> dict[str, Any]:
        placed = {name: camera_in_world(S_world_recon, camera) for name, camera in cameras.items()}
        return {name: camera.T_world_cam.tolist() for name, camera in placed.items()}

    nothing = dict.fromkeys(estimates["scan"])
    return estimates | {
        "S_world_recon": S_world_recon.tolist(),
        "scan": nothing | poses(cameras_recon),
        "demo_cameras": poses(demo_cameras_recon),
    }


def paper_figures(scored: dict[str, Any], seconds: float) -> dict[str, Any]:
    """The comparable ones of a twin's figures, under names of their own."""
    kept = {name: value for name, value in scored.items() if name.startswith(GROUPS)}
    return {PREFIX + name: value for name, value in kept.items()} | {f"{PREFIX}seconds": round(seconds, 1)}


def methods_table(figures: dict[str, Any]) -> str:
    """One row for each figure that both methods have."""
    names = [name.removeprefix(PREFIX) for name in figures if name.startswith(PREFIX)]
    return as_table(
        [
            {"figure": name, "outlines": figures[name], "paper": figures[PREFIX + name]}
            for name in names
            if isinstance(figures.get(name), float | int | None) and name in figures
        ]
    )
