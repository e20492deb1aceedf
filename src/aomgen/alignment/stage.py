"""Loading and saving of the alignment stage."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aomgen.alignment.align import Alignment, AlignmentParams, align
from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.pose_search import Scan
from aomgen.alignment.starting_poses import RobotBox
from aomgen.alignment.uncertainty import CameraErrors, camera_covariance
from aomgen.core.held_out import held_out
from aomgen.core.progress import Progress
from aomgen.core.recording import Prompt
from aomgen.core.structure import Structure
from aomgen.errors import MalformedFileError
from aomgen.io.atomic import write_json
from aomgen.io.images import read_image
from aomgen.io.jsonfile import read_json
from aomgen.robots.configuration import RobotPosture

ALIGNMENT_FILE = "alignment.json"


def run_alignment(
    structure: Structure,
    images: Mapping[str, Path],
    demo_first_srgb: Mapping[str, NDArray[np.uint8]],
    prompts: tuple[Prompt, ...],
    posture: RobotPosture,
    folder: Path,
    progress: Progress,
    params: AlignmentParams | None = None,
    seed: int = 0,
) -> Alignment:
    """Align (see `align`) and write `alignment.json`.

    Args:
        structure: Cameras and sparse points, recon frame.
        images: Scan images by file name; held-out ones are not looked at.
        demo_first_srgb: First frame (H, W, 3) of each fixed camera's video, robot as in the scan.
        prompts: Of the capture; those of the robot that carry a box are used.
        posture: Robot and its joint values during the scan.
        folder: Receives the result.
        progress: Called at each step.
        params: Effort and limits.
        seed: Of the plane search.

    Raises:
        AlignmentError: See `align`.
    """
    scan = Scan(
        views=views_of(structure, images, demo_first_srgb),
        boxes=boxes_of(structure, prompts, ("robot",)),
        points_recon=structure.points_recon,
        errors=camera_errors_of(structure),
    )
    result = align(scan, posture, progress, np.random.default_rng(seed), params)
    save_alignment(result, folder)
    return result


def camera_errors_of(structure: Structure) -> CameraErrors:
    """How far the scan cameras may be off, by the structure's own observations, recon frame."""
    return CameraErrors(
        names=tuple(structure.cameras_recon),
        covariance=camera_covariance(
            list(structure.cameras_recon.values()),
            structure.points_recon,
            structure.observations,
            structure.reprojection_error_px,
        ),
    )


def views_of(
    structure: Structure, images: Mapping[str, Path], demo_first_srgb: Mapping[str, NDArray[np.uint8]]
) -> list[AlignmentImage]:
    """Scan images that are not held out, and the first frames of the fixed cameras."""
    withheld = set(held_out(list(images)))
    views = [
        AlignmentImage(name=name, camera_recon=camera, image_srgb=read_image(images[name]))
        for name, camera in structure.cameras_recon.items()
        if name not in withheld
    ]
    return views + [
        AlignmentImage(name=name, camera_recon=structure.demo_cameras_recon[name], image_srgb=image)
        for name, image in demo_first_srgb.items()
        if name in structure.demo_cameras_recon
    ]


def boxes_of(structure: Structure, prompts: tuple[Prompt, ...], parts: tuple[str, ...]) -> list[RobotBox]:
    """Prompted boxes of some parts, on images that have a camera."""
    return [
        RobotBox(camera_recon=structure.cameras_recon[prompt.image], box_px=prompt.box)
        for prompt in prompts
        if prompt.part in parts and len(prompt.box) == 4 and prompt.image in structure.cameras_recon
    ]


def save_alignment(result: Alignment, folder: Path) -> None:
    """Write an alignment into a folder."""
    write_json(
        folder / ALIGNMENT_FILE,
        {
            "format": 1,
            "S_world_recon": result.S_world_recon,
            "support": result.support,
            "chance": result.chance,
            "runner_up_support": result.runner_up_support,
            "residual_px": result.residual_px,
            "residual_px_of_view": result.residual_px_of_view,
            "ee_sd_m": result.ee_sd_m,
            "joint_zeros_rad": result.joint_zeros_rad,
            "joint_zero_sds_rad": result.joint_zero_sds_rad,
        },
    )


def load_alignment(folder: Path) -> Alignment:
    """Read what `save_alignment` wrote.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: As their names say.
    """
    path = folder / ALIGNMENT_FILE
    stored = read_json(path)
    try:
        return Alignment(**{name: value for name, value in stored.items() if name != "format"})
    except (ValueError, TypeError, AttributeError) as error:
        raise MalformedFileError(
            path, f"does not hold an alignment ({error})", "run the stage again"
        ) from error
