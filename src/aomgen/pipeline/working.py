"""The capture as later stages see it: stills of a pinhole camera, then joints with their zeros."""

from dataclasses import replace
from pathlib import Path

from aomgen.alignment.stage import load_alignment
from aomgen.capture.read import read_capture
from aomgen.core.recording import Capture
from aomgen.pipeline.stage import Run
from aomgen.structure.stage import load_structure
from aomgen.structure.undistortion import IMAGES_FOLDER, MASKS_FOLDER, undistort_prompts
from aomgen.structure.video_frames import find_extracted_frames


def capture_of(run: Run) -> Capture:
    """The run's capture, as `working_capture` gives it."""
    return working_capture(read_capture(run.project.capture), run.folders["structure"])


def aligned_capture_of(run: Run) -> Capture:
    """The run's capture as stages after alignment see it: joints of log and scan are the robot's own."""
    return with_joint_zeros(capture_of(run), run.folders["alignment"])


def with_joint_zeros(capture: Capture, alignment: Path) -> Capture:
    """A capture with the joint zeros that the alignment found added to its log and to the scan's joints.

    Args:
        capture: As recorded.
        alignment: Folder of the finished alignment stage.

    Raises:
        MissingFileError, MalformedFileError: The alignment stage has not finished there.
    """
    zeros_rad = load_alignment(alignment).joint_zeros_rad
    log, robot = capture.joint_log, capture.robot
    return replace(
        capture,
        joint_log=replace(log, joints=log.joints + zeros_rad),
        robot=replace(robot, scan_joints=robot.scan_joints + zeros_rad),
    )


def working_capture(capture: Capture, structure: Path) -> Capture:
    """A capture whose images, masks, prompts and videos are those of pinhole cameras.

    Of an ordinary capture nothing changes. A scan video is replaced by its chosen frames. Where
    the lens bends, the undistorted images and masks of the structure stage take the place of the
    recorded ones, prompts are moved with them, and `read_demo_videos` undistorts the frames of
    the cameras that need it.

    Args:
        capture: As recorded.
        structure: Folder of the finished structure stage.

    Raises:
        MissingFileError, MalformedFileError: The structure stage has not finished there.
    """
    found = load_structure(structure)
    images = capture.scan_images
    if capture.scan_video is not None:
        images = tuple(find_extracted_frames(structure).values())
    cameras = tuple(replace(camera, lens=found.demo_lenses.get(camera.name)) for camera in capture.cameras)
    if found.scan_lens is None:
        return replace(capture, cameras=cameras, scan_images=images)
    masks = structure / MASKS_FOLDER
    return replace(
        capture,
        cameras=cameras,
        scan_images=tuple(structure / IMAGES_FOLDER / path.name for path in images),
        prompts=undistort_prompts(capture.prompts, found.scan_lens),
        mask_folders={name: masks / name for name in capture.mask_folders if (masks / name).is_dir()},
    )
