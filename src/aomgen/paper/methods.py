"""The stages that a project may have done as the paper does them, chosen by its `*_method`s."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.stage import boxes_of, calibrate_cameras, views_of
from aomgen.core.alignment import Alignment
from aomgen.core.motion import MotionEstimate
from aomgen.core.progress import Progress, part
from aomgen.core.transforms import apply, invert
from aomgen.motion.estimate import OnCurve, estimate_motion
from aomgen.motion.stage import motion_input, recover_motion
from aomgen.paper.affinity_features import AffinityParams
from aomgen.paper.affinity_parts import MASKS_FOLDER, affinity_evidence, segment_views
from aomgen.paper.icp_alignment import align_as_paper
from aomgen.paper.mask_keyframes import part_masks
from aomgen.paper.motion_estimate import estimate_motion_paper
from aomgen.parts import stage as parts_stage
from aomgen.parts.label import SEED, MotionEvidence
from aomgen.parts.likelihood import PartEvidence
from aomgen.parts.prompted_images import PromptedImage
from aomgen.parts.scan_views import ScanView
from aomgen.results import Results
from aomgen.robots.robot import RobotConfiguration
from aomgen.segmentation.interface import Segmenter

# Boxes are larger by this on every side: Gaussians lie some millimetres off the surface that they paint.
MARGIN_M = 0.005


def run_alignment(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run rigid ICP and link boxes; the paper keeps fixed cameras at their pose in the scan."""
    return calibrate_cameras(results, align_scan(results), folder, progress, BundleParams(frames=0))


def align_scan(results: Results) -> Alignment:
    """Align by the paper's method, see `align_as_paper`."""
    capture, structure = results.pinhole_capture, results.structure
    return align_as_paper(
        views_of(structure, results.scan_images, {}),
        boxes_of(structure, capture.prompts, ("robot",)),
        results.gaussians_recon,
        results.configuration_in(capture),
        np.random.default_rng(0),
    )


def run_parts(
    results: Results, folder: Path, progress: Progress, motion_evidence: MotionEvidence
) -> dict[str, Any]:
    """Use link boxes for the robot with the paper's alignment, and affinity features with the method "saga"."""
    project = results.project
    robot = label_robot_by_boxes if project.alignment_method == "paper" else parts_stage.label_robot_by_links
    evidence = partial(learn_affinity, folder) if project.parts_method == "saga" else parts_stage.no_evidence
    return parts_stage.run(results, folder, progress, motion_evidence, robot, evidence)


def label_robot_by_boxes(results: Results, views: list[ScanView]) -> NDArray[np.int32]:
    """Assign each Gaussian to the link whose bounding box contains it."""
    return bodies_in_boxes(results.gaussians.means, results.configuration)


def bodies_in_boxes(points_world: ArrayLike, configuration: RobotConfiguration) -> NDArray[np.int32]:
    """Find the robot body (N,) whose box contains each point (N, 3), [m]: index into `robot.body_names`, -1 for none.

    Boxes are those of the meshes along the axes of their body. Of several boxes the one counts in
    whose middle the point lies most.

    Source: AOMGen, sec. 4.2, "Robot". Not checked: any other surface within a box counts as robot.
    """
    points = np.asarray(points_world, np.float64)
    poses = configuration.robot.link_poses(configuration.joints[None], configuration.gripper)[0]
    owners = np.full(len(points), -1, np.int32)
    depth = np.ones(len(points))
    for body in sorted({mesh.body for mesh in configuration.robot.meshes}):
        vertices = np.concatenate(
            [mesh.vertices_body for mesh in configuration.robot.meshes if mesh.body == body]
        )
        low, high = vertices.min(0) - MARGIN_M, vertices.max(0) + MARGIN_M
        local = apply(invert(poses[body]), points)
        # 0 in the middle of the box, 1 on its faces.
        place = np.abs(2 * (local - low) / (high - low) - 1).max(1)
        nearer = place < depth
        owners[nearer], depth[nearer] = body, place[nearer]
    return owners


def learn_affinity(
    folder: Path,
    results: Results,
    views: list[ScanView],
    prompted: Sequence[PromptedImage],
    segmenter: Segmenter,
    progress: Progress,
) -> PartEvidence:
    """Compute automatic masks and learn affinity features from them; the masks are stored in the stage's folder."""
    params, rng = AffinityParams(), np.random.default_rng(SEED)
    masks = segment_views(
        results.gaussians,
        views,
        prompted,
        segmenter,
        part(progress, 0.0, 0.5),
        params.views,
        folder / MASKS_FOLDER,
    )
    return affinity_evidence(results.gaussians, views, masks, prompted, part(progress, 0.5, 1.0), params, rng)


def run_motion(results: Results, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run the paper's AOMotion with its formulas as printed.

    The paper takes the joint's type as known; here it is the one that our own estimator finds, so both
    must succeed.
    """

    def estimate(results: Results, progress: Progress, on_curve: OnCurve) -> MotionEstimate:
        demonstration = motion_input(results, results.scene, results.parts.labels)
        masks = part_masks(results.capture, results.capture.cameras[0], demonstration)
        ours = estimate_motion(demonstration, None, part(progress, 0.0, 0.7), on_curve)
        rest = part(progress, 0.7, 1.0)
        return estimate_motion_paper(demonstration, masks, ours.joint.type, "printed", rest, on_curve)

    return recover_motion(results, folder, progress, estimate)
