"""Masks of the moving part over the demonstration, for the paper's keyframes."""

from aomgen.capture.label_images import read_demo_masks
from aomgen.conventions import MOVING
from aomgen.core.recording import Capture, DemoCamera
from aomgen.motion.inputs import MotionInput
from aomgen.paper.mask_keyframes import PartMasks
from aomgen.paper.moved_masks import masks_by_change
from aomgen.robots.robot_masks import robot_masks


def part_masks(capture: Capture, camera: DemoCamera, demonstration: MotionInput) -> PartMasks:
    """Moving part and robot in every frame: the part's from the capture's own label images, else from
    what changed in the video; the robot's drawn from its log.

    Raises:
        InputError: See `read_demo_masks`.
    """
    demo = demonstration
    count, height, width = demo.video.frames_srgb.shape[:3]
    labels = read_demo_masks(capture, camera, (count, height, width))
    if labels is None:
        return masks_by_change(demo)
    with robot_masks(demo.robot, demo.camera, demo.log) as masks_at:
        robot = masks_at(demo.video.times_s, width, height)
    return PartMasks(moving=labels == MOVING, robot=robot)
