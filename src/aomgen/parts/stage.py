"""Stage that labels every Gaussian with its part and robot link, and surveys the coverage of the scan. [paper 4.1]"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import MOVING, ROBOT, STATIC
from aomgen.core.parts import Parts
from aomgen.core.progress import Progress, part
from aomgen.core.structure import held_out
from aomgen.io.artifact import save_artifact
from aomgen.io.images import read_image
from aomgen.parts.label import SEED, MotionEvidence, find_moving_parts, segment_scan
from aomgen.parts.likelihood import PartEvidence
from aomgen.parts.prompted_images import PromptedImage, segment_prompts
from aomgen.parts.scan_views import ScanView, label_robot
from aomgen.parts.survey import Survey, survey
from aomgen.results import Results
from aomgen.robots.silhouette import SilhouetteRenderer
from aomgen.segmentation.interface import Segmenter
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.splatting.surfaces import view_depths

# Name of the stored coverage, in the folder of the labels.
COVERAGE = "coverage"

# Finds the robot body (N,) that carries each Gaussian, -1 where it is not of the robot.
LabelRobot = Callable[[Results, list[ScanView]], NDArray[np.int32]]
# Computes evidence of the object's parts by another method than boxes; None for boxes.
GivenEvidence = Callable[
    [Results, list[ScanView], Sequence[PromptedImage], Segmenter, Progress], PartEvidence | None
]


def label_robot_by_links(results: Results, views: list[ScanView]) -> NDArray[np.int32]:
    """Label Gaussians inside the robot's masks with the nearest link of the model."""
    return label_robot(results.gaussians, views, results.configuration, np.random.default_rng(SEED))


def no_evidence(*_: object) -> None:
    """Return no evidence of another method, so that boxes are used."""


def run(
    results: Results,
    folder: Path,
    progress: Progress,
    motion_evidence: MotionEvidence,
    label_robot: LabelRobot = label_robot_by_links,
    given_evidence: GivenEvidence = no_evidence,
) -> dict[str, Any]:
    """Label the Gaussians by prompts and demonstration, and survey the coverage of the sides of all parts."""
    capture = results.capture
    views = load_scan_views(results)
    progress(0.1, "robot rendered into the scan")
    bodies = label_robot(results, views)
    progress(0.2, "robot labelled")
    segmenter = choose_segmenter(capture.mask_folders, results.project.segmenter)
    prompted = segment_prompts(views, capture.prompts, segmenter)
    progress(0.4, "prompts segmented")
    given = given_evidence(results, views, prompted, segmenter, part(progress, 0.4, 0.5))
    scan = segment_scan(results.gaussians, views, bodies, prompted, given)
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


def load_scan_views(results: Results) -> list[ScanView]:
    """Load the scan images that are not held out, world frame, with the mask of the robot."""
    withheld, configuration = set(held_out(list(results.scan_images))), results.configuration
    width = max(camera.width for camera in results.scan_cameras.values())
    height = max(camera.height for camera in results.scan_cameras.values())
    views = []
    with SilhouetteRenderer(configuration.robot, max_width=width, max_height=height) as renderer:
        for name, camera in results.scan_cameras.items():
            if name not in withheld:
                bodies, _ = renderer.draw(camera, configuration.joints, configuration.gripper)
                image = read_image(results.scan_images[name])
                views.append(ScanView(name=name, camera=camera, image_srgb=image, robot=bodies >= 0))
    return views


def survey_parts(results: Results, parts: Parts) -> Survey:
    """Survey the coverage of the sides of object, robot and table, without held-out images."""
    withheld = set(held_out([*results.structure.cameras_recon, *results.structure.dropped]))
    cameras = [camera for name, camera in results.scan_cameras.items() if name not in withheld]
    world = parts.cut.apply(results.gaussians)
    views = view_depths(world, cameras)
    return survey(world, parts.labels, results.configuration, views, np.random.default_rng(SEED))
