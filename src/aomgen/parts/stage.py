"""A part label for every Gaussian, the robot link that carries it, and which sides the scan saw. [paper 4.1]"""

from pathlib import Path
from typing import Any

import numpy as np

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.held_out import held_out
from aomgen.core.parts import Parts
from aomgen.core.progress import Progress, part
from aomgen.io.artifact import save_artifact
from aomgen.io.images import read_image
from aomgen.parts.affinity_parts import AffinityPartsParams
from aomgen.parts.label import PartsParams, segment_scan
from aomgen.parts.moving_parts import MotionEvidence, find_moving_parts
from aomgen.parts.scan_views import ScanView
from aomgen.parts.survey import Survey, survey
from aomgen.results import Results
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.splatting.surfaces import view_depths

MASKS_FOLDER = "automatic_masks"
# Name of the coverage maps beside the labels.
COVERAGE = "coverage"
# Of the samples of the survey, fixed so that a run can be repeated.
SEED = 0


def run(
    results: Results, folder: Path, progress: Progress, motion_evidence: MotionEvidence
) -> dict[str, Any]:
    """Label the Gaussians by prompts and demonstration, and survey how the sides of all parts were seen."""
    project, capture = results.project, results.capture
    views = scan_views(results)
    progress(0.1, "robot drawn into the scan")
    scan = segment_scan(
        results.gaussians,
        views,
        capture.prompts,
        choose_segmenter(capture.mask_folders, project.segmenter),
        results.posture,
        part(progress, 0.1, 0.5),
        PartsParams(
            method=project.parts_method,
            affinity=AffinityPartsParams(masks_folder=folder / MASKS_FOLDER),
            robot="boxes" if project.alignment_method == "paper" else "links",
        ),
    )
    found = find_moving_parts(scan, motion_evidence, part(progress, 0.5, 1.0))
    save_artifact(folder, "parts", found)
    seen = survey_parts(results, found)
    save_artifact(folder, COVERAGE, seen)
    counts = np.bincount(found.labels, minlength=4)
    return {
        "robot": int(counts[ROBOT]),
        "static": int(counts[STATIC]),
        "moving": int(counts[MOVING]),
        "static_agreement": found.static_agreement,
        "moving_agreement": found.moving_agreement,
        "method": found.method,
        "box_misfit": found.box_misfit,
        "coverage": seen.figures(),
        "warnings": [*found.warnings(), *seen.warnings()],
    }


def scan_views(results: Results) -> list[ScanView]:
    """The scan images that are not held out, world frame, with the robot drawn into them."""
    withheld, posture = set(held_out(list(results.scan_images))), results.posture
    width = max(camera.width for camera in results.scan_cameras.values())
    height = max(camera.height for camera in results.scan_cameras.values())
    views = []
    with SilhouetteRenderer(posture.robot, max_width=width, max_height=height) as renderer:
        for name, camera in results.scan_cameras.items():
            if name not in withheld:
                bodies, _ = renderer.draw(camera, posture.joints, posture.gripper)
                image = read_image(results.scan_images[name])
                views.append(ScanView(name=name, camera=camera, image_srgb=image, robot=bodies >= 0))
    return views


def survey_parts(results: Results, parts: Parts) -> Survey:
    """How the sides of object, robot and table were seen; held-out images do not count."""
    withheld = set(held_out([*results.structure.cameras_recon, *results.structure.dropped]))
    cameras = [camera for name, camera in results.scan_cameras.items() if name not in withheld]
    world = parts.cut.applied(results.gaussians)
    views = view_depths(world, cameras)
    return survey(world, parts.labels, results.posture, views, np.random.default_rng(SEED))
