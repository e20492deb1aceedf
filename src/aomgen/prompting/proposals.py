"""Propose the prompts of a capture from its demonstration: robot, moving part, and body of the object.

The scan is reconstructed with few features, and the robot is aligned with a box around the region that moves in the
video. Then the robot model gives the robot's mask in every image, and the joint log the metric motion of the gripper.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from aomgen.alignment.bundle_terms import BundleParams
from aomgen.alignment.stage import align_scan, calibrate_cameras
from aomgen.alignment.starting_poses import RobotBox
from aomgen.capture.capture_schema import PromptSection, read_manifest
from aomgen.capture.demo_videos import check_demo_video
from aomgen.capture.prompts import PARTS, list_boxed_images
from aomgen.capture.read import read_capture
from aomgen.core.alignment import Alignment
from aomgen.core.lens import Lens
from aomgen.core.progress import Progress, part
from aomgen.core.project import Project
from aomgen.core.recording import CAPTURE_FILE, Recording
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.errors import AlignmentError, ConfigError, NoMotionError
from aomgen.motion.inputs import GripperSignals, find_touch
from aomgen.parts.scan_views import ScanView, nearest_links
from aomgen.parts.stage import load_scan_views
from aomgen.prompting.moved_panel import Front, Grip, RegionAgreement, fit_region
from aomgen.prompting.object_body import find_body, find_object_points
from aomgen.prompting.panel_edges import refine_front
from aomgen.prompting.prompts_file import save_prompts
from aomgen.prompting.session import MARGIN_PX, WANTED_IMAGES, box_of_mask
from aomgen.prompting.video_regions import REMEDY, compare_states, find_moved_region, find_robot_boxes
from aomgen.prompting.view_choice import choose_apart, choose_front_views
from aomgen.results import Results
from aomgen.robots.silhouette import robot_masks
from aomgen.segmentation.interface import Segmenter
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.structure import stage as structure_stage

# Seed of the sampled rectangles, planes and points; any value serves.
SEED: Final = 0
# Number of features per image; the reconstruction of 64 images of 640 px takes half a minute.
MAX_FEATURES: Final = 1024
# Images whose long side is at most this are enlarged twofold for the features, [px]; otherwise they have too few.
SMALL_PX: Final = 480
# Sparse points within this distance of the robot's surface belong to the robot, [m].
ROBOT_M: Final = 0.03
# Angle between the two images on which the robot and the moving part are proposed, [deg].
ROBOT_APART_DEG, MOVING_APART_DEG = 40.0, 35.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """A box around a part in a scan image, in pixels of the undistorted image (4,), and its confidence 0..1."""

    part: str
    view: ScanView
    box: Array
    confidence: float


@dataclass(frozen=True)
class _Unprompted(Results):
    """Results of a capture whose prompts may be missing."""

    @cached_property
    def recorded(self) -> Recording:
        return read_capture(self.project.capture, complete=False)


def write_proposals(capture: Path, progress: Progress) -> list[PromptSection]:
    """Add prompts, marked as proposals, for all parts without prompts to a capture.toml, and return them.

    Nothing is written unless all of them were found; other bytes of the file remain unchanged.

    Raises:
        ConfigError: The capture already has prompts of all parts.
        InputError, BackendError, EstimationError: The capture, the machine or the video is not sufficient.
    """
    path = capture / CAPTURE_FILE
    recorded = read_capture(capture, complete=False)
    present = read_manifest(path).prompts
    missing = [name for name, images in list_boxed_images(present).items() if not images]
    if not missing:
        raise ConfigError(
            path,
            f"has prompts of {', '.join(PARTS)} already",
            "delete those that shall be proposed, or correct them with `aomgen prompts`",
        )
    segmenter = choose_segmenter({}, "mobile_sam")
    with tempfile.TemporaryDirectory(prefix="aomgen-propose-") as scratch:
        small = max(recorded.scan_size) <= SMALL_PX
        params = {"structure": {"max_features": MAX_FEATURES, "first_octave": -1 if small else 0}}
        folders = {name: Path(scratch) / name for name in ("structure", "alignment")}
        for folder in folders.values():
            folder.mkdir()
        project = Project(capture=capture, out=Path(scratch), params=params)
        results = _Unprompted(project=project, out=Path(scratch), folders=folders)
        locate_robot(results, part(progress, 0.0, 0.7))
        found = propose_prompts(results, segmenter, missing, part(progress, 0.7, 1.0))
        sections = [as_section(item, results.structure.scan_lens, recorded.scan_size) for item in found]
    save_prompts(path, [*present, *sections], {})
    return sections


def locate_robot(results: Results, progress: Progress) -> None:
    """Reconstruct the scan and align the robot, with its prompts or else with the moving region of the video.

    Raises:
        InputError, EstimationError: The scan or the video is not sufficient.
    """
    for camera in results.recorded.cameras:
        check_demo_video(results.recorded_videos[camera.name], camera.video)
    structure_stage.run(results, results.folders["structure"], part(progress, 0.0, 0.6))
    found = _align(results, part(progress, 0.6, 0.9))
    # Camera poses from the scan are sufficient for boxes; without frames only the clock is estimated.
    calibrate_cameras(
        results, found, results.folders["alignment"], part(progress, 0.9, 1.0), BundleParams(frames=0)
    )


def _align(results: Results, progress: Progress) -> Alignment:
    """Align the robot with its prompts, or with the first box of the video that the images confirm.

    Raises:
        AlignmentError: The images confirm no box; the error is that of the likeliest box.
    """
    if any(prompt.part == "robot" for prompt in results.recorded.prompts):
        return align_scan(results, progress)
    camera, video = (
        results.structure.demo_cameras_recon[results.demo_camera],
        results.videos[results.demo_camera],
    )
    refused: list[AlignmentError] = []
    for box in find_robot_boxes(video.frames_srgb):
        try:
            return align_scan(results, progress, [RobotBox(camera_recon=camera, box_px=box)])
        except AlignmentError as error:
            refused.append(error)
    first = refused[0]
    raise AlignmentError("robot in the demonstration video", first.problem, REMEDY) from first


def propose_prompts(
    results: Results, segmenter: Segmenter, parts: Sequence[str], progress: Progress
) -> list[Proposal]:
    """Propose a box of each part on two images, for a capture whose structure and alignment are known.

    Args:
        segmenter: Segmenter of the moved part in the video and of the body in the scan.
        parts: Parts to propose, of `PARTS`.

    Raises:
        EstimationError: The video shows no part that moves with the gripper, or the scan does not show it.
    """
    views = load_scan_views(results)
    proposals: list[Proposal] = []
    if "robot" in parts:
        proposals += _propose_robot(results, views)
    if set(parts) == {"robot"}:
        return proposals
    progress(0.1, "finding what has moved in the video")
    rng = np.random.default_rng(SEED)
    front = find_front(results, segmenter, views, rng)
    if "static" in parts:
        progress(0.6, "segmenting the body of the object")
        points = apply(results.alignment.S_world_recon, results.structure.points_recon)
        points = points[nearest_links(points, results.configuration, rng, ROBOT_M)[0] < 0]
        own, support_z = find_object_points(points, front, rng)
        bodies = [
            Proposal(part="static", view=view, box=np.array(box_of_mask(mask)), confidence=agreement)
            for view, mask, agreement in find_body(own, support_z, front, views, segmenter)
            if mask.any()
        ]
        proposals += bodies[:WANTED_IMAGES]
    if "moving" in parts:
        proposals += _propose_moving(front, views)
    return proposals


def find_front(
    results: Results, segmenter: Segmenter, views: Sequence[ScanView], rng: np.random.Generator
) -> Front:
    """Find the front of the moving part from the first fixed camera's video; errors as for `propose_prompts`."""
    video, camera = results.videos[results.demo_camera], results.fixed_camera.camera
    log, times = results.demo_log, video.times_s
    joints, gripper = log.at(times)
    Ts_world_ee = results.robot.ee_poses(joints)
    touch = find_touch(
        GripperSignals(
            times_s=times,
            Ts_world_ee=Ts_world_ee,
            speeds_m_s=np.zeros(len(times)),
            gripper=gripper,
            # The distance to the part is still unknown, so the first grasp is used.
            distances_m=np.zeros(len(times)),
        )
    )
    if not touch.gripped:
        raise NoMotionError(
            results.recorded.joint_log_file,
            "shows no grasp, so it is not known when the gripper touches the part",
            REMEDY,
        )
    with robot_masks(results.robot, camera, log) as masks_at:
        robot = masks_at(times, camera.width, camera.height)
    after_srgb, changed, seen = compare_states(video.frames_srgb, robot, touch.first, touch.last)
    grip = Grip(T_world_first=Ts_world_ee[touch.first], T_world_last=Ts_world_ee[touch.last])
    gripper_px = camera.project(grip.T_world_last[None, :3, 3])[0][0]
    image = segmenter.prepare("after the motion", after_srgb)
    region = find_moved_region(image, changed, seen, gripper_px)
    agreement = RegionAgreement(region, np.asarray(robot[touch.last :].all(0)), camera, grip)
    x, model = fit_region(agreement, rng)
    return refine_front(x, model, agreement, views, rng)


def _propose_robot(results: Results, views: Sequence[ScanView]) -> list[Proposal]:
    """Choose two images that show the robot as large and complete as possible, from different sides."""
    center = results.configuration.points_world().mean(0)
    sizes = [view.robot.sum() / (1 + _count_cut_sides(view)) for view in views]
    ordered = [views[k] for k in np.argsort(sizes)[::-1] if sizes[k] > 0]
    alignment = results.alignment
    # The support of the outline minus that by chance or of the second-best pose.
    confidence = alignment.support - max(alignment.chance, alignment.runner_up_support)
    return [
        Proposal(part="robot", view=view, box=np.array(box_of_mask(view.robot)), confidence=confidence)
        for view in choose_apart(ordered, center, WANTED_IMAGES, ROBOT_APART_DEG)
    ]


def _count_cut_sides(view: ScanView) -> int:
    return sum(
        bool(edge.any()) for edge in (view.robot[0], view.robot[-1], view.robot[:, 0], view.robot[:, -1])
    )


def _propose_moving(front: Front, views: Sequence[ScanView]) -> list[Proposal]:
    shown = choose_front_views(views, front)
    chosen = choose_apart(shown, front.center, WANTED_IMAGES, MOVING_APART_DEG)
    proposals = []
    for view in chosen:
        pixels = view.camera.project(front.corners_world)[0]
        box = np.concatenate([pixels.min(0) - MARGIN_PX, pixels.max(0) + MARGIN_PX])
        proposals.append(Proposal(part="moving", view=view, box=box, confidence=front.confidence))
    return proposals


def as_section(proposal: Proposal, lens: Lens | None, size: tuple[int, int]) -> PromptSection:
    """Convert a proposal to pixels of the recorded image, which has a lens and a size (width, height), [px]."""
    box, camera = proposal.box, proposal.view.camera
    if lens is not None:
        share = np.linspace(0, 1, 16)
        x, y = box[0] + share * (box[2] - box[0]), box[1] + share * (box[3] - box[1])
        sides = [(x, box[1]), (x, box[3]), (box[0], y), (box[2], y)]
        outline = np.concatenate([np.stack(np.broadcast_arrays(u, v), 1) for u, v in sides])
        bent = lens.pixels((outline - [camera.cx, camera.cy]) / [camera.fx, camera.fy])
        box = np.concatenate([bent.min(0), bent.max(0)])
    box = np.clip(box, 0, 2 * size)
    return PromptSection(
        part=proposal.part,  # pyright: ignore[reportArgumentType]
        image=proposal.view.name,
        box=[round(float(value), 1) for value in box],
        proposed=True,
        confidence=round(float(np.clip(proposal.confidence, 0, 1)), 2),
    )
