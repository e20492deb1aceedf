"""Loading and saving of the parts stage."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aomgen.core.camera import camera_in_world
from aomgen.core.gaussians import Gaussians
from aomgen.core.held_out import held_out
from aomgen.core.structure import Structure
from aomgen.core.values import Array
from aomgen.errors import MalformedFileError
from aomgen.io.arrays import npz_bytes, read_npz
from aomgen.io.atomic import write_bytes
from aomgen.io.images import read_image
from aomgen.parts.cutting import Cut
from aomgen.parts.label import Parts
from aomgen.parts.prompted_images import ScanView
from aomgen.robots.configuration import RobotPosture
from aomgen.robots.silhouette import SilhouetteRenderer

PARTS_FILE = "parts.npz"
# Arrays of the pieces of Gaussians that were cut.
PIECES = ("means", "quats", "scales", "opacities", "sh")


def scan_views(
    structure: Structure, S_world_recon: Array, images: Mapping[str, Path], posture: RobotPosture
) -> list[ScanView]:
    """The scan images that are not held out, world frame, with the robot drawn into them.

    Args:
        structure: Cameras, recon frame.
        S_world_recon: The alignment.
        images: All scan images by file name.
        posture: Robot as scanned.
    """
    withheld = set(held_out(list(images)))
    cameras = {n: camera_in_world(S_world_recon, c) for n, c in structure.cameras_recon.items()}
    width = max(camera.width for camera in cameras.values())
    height = max(camera.height for camera in cameras.values())
    views = []
    with SilhouetteRenderer(posture.robot, max_width=width, max_height=height) as renderer:
        for name, camera in cameras.items():
            if name not in withheld:
                bodies, _ = renderer.draw(camera, posture.joints, posture.gripper)
                image = read_image(images[name])
                views.append(ScanView(name=name, camera=camera, image_srgb=image, robot=bodies >= 0))
    return views


def save_parts(parts: Parts, folder: Path) -> None:
    """Write labels into a folder; equal parts give equal bytes."""
    pieces = {name: getattr(parts.cut.pieces, name) for name in PIECES}
    arrays = {
        "labels": parts.labels,
        "robot_bodies": parts.robot_bodies,
        "cut_sources": parts.cut.sources,
        **{f"cut_{name}": array for name, array in pieces.items()},
        "method": np.array(parts.method, dtype=np.str_),
        "box_misfit": np.array(parts.box_misfit),
        "static_agreement": np.array(parts.static_agreement),
        "moving_agreement": np.array(parts.moving_agreement),
    }
    write_bytes(folder / PARTS_FILE, npz_bytes(arrays))


def load_parts(folder: Path) -> Parts:
    """Read what `save_parts` wrote.

    Raises:
        MissingFileError, LimitExceededError, MalformedFileError: As their names say.
    """
    arrays = read_npz(folder / PARTS_FILE)
    try:
        pieces = Gaussians(**{name: arrays[f"cut_{name}"] for name in PIECES})
        return Parts(
            labels=arrays["labels"],
            robot_bodies=arrays["robot_bodies"],
            cut=Cut(sources=arrays["cut_sources"], pieces=pieces),
            method=str(arrays["method"]),
            box_misfit=float(arrays["box_misfit"]),
            static_agreement=float(arrays["static_agreement"]),
            moving_agreement=float(arrays["moving_agreement"]),
        )
    except (ValueError, KeyError) as error:
        raise MalformedFileError(
            folder / PARTS_FILE, f"does not hold part labels ({error})", "run the stage again"
        ) from error
