"""Loading and saving of the structure stage."""

import io
from dataclasses import asdict
from pathlib import Path

import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.lens import Lens
from aomgen.core.progress import Progress, part
from aomgen.core.structure import Structure
from aomgen.errors import MalformedFileError, MissingFileError
from aomgen.io.atomic import write_bytes, write_json
from aomgen.io.jsonfile import read_json
from aomgen.structure.reconstruct import Photographs, StructureParams, reconstruct_structure
from aomgen.structure.undistortion import write_undistorted

CAMERAS_FILE = "structure.json"
POINTS_FILE = "points.npz"


def run_structure(
    photographs: Photographs,
    mask_folders: dict[str, Path],
    folder: Path,
    progress: Progress,
    params: StructureParams | None = None,
) -> Structure:
    """Reconstruct (see `reconstruct_structure`) and write `structure.json`, `points.npz`.

    When the scan is distorted, its images and masks are written undistorted as well.
    """
    structure = reconstruct_structure(photographs, params or StructureParams(), part(progress, 0.0, 0.97))
    save_structure(structure, folder)
    if structure.scan_lens is not None:
        later = part(progress, 0.97, 1.0)
        write_undistorted(photographs.images, mask_folders, structure.scan_lens, folder, later)
    progress(1.0, "structure written")
    return structure


def save_structure(structure: Structure, folder: Path) -> None:
    """Write a structure into a folder."""
    write_json(
        folder / CAMERAS_FILE,
        {
            "format": 1,
            "cameras_recon": {name: _camera_json(c) for name, c in structure.cameras_recon.items()},
            "demo_cameras_recon": {name: _camera_json(c) for name, c in structure.demo_cameras_recon.items()},
            "scan_lens": None if structure.scan_lens is None else asdict(structure.scan_lens),
            "demo_lenses": {name: asdict(lens) for name, lens in structure.demo_lenses.items()},
            "dropped": structure.dropped,
            "reprojection_error_px": structure.reprojection_error_px,
            "figures": structure.figures,
        },
    )
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        points_recon=structure.points_recon,
        colors_srgb=structure.colors_srgb,
        observations=structure.observations,
    )
    write_bytes(folder / POINTS_FILE, buffer.getvalue())


def load_structure(folder: Path) -> Structure:
    """Read what `save_structure` wrote.

    Raises:
        MissingFileError, MalformedFileError, LimitExceededError: As their names say.
    """
    stored = read_json(folder / CAMERAS_FILE)
    path = folder / POINTS_FILE
    if not path.is_file():
        raise MissingFileError(path, "is missing", "run the structure stage again")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Structure(
                cameras_recon={name: Camera(**c) for name, c in sorted(stored["cameras_recon"].items())},
                demo_cameras_recon={name: Camera(**c) for name, c in stored["demo_cameras_recon"].items()},
                scan_lens=Lens(**stored["scan_lens"]) if stored.get("scan_lens") else None,
                demo_lenses={name: Lens(**lens) for name, lens in stored.get("demo_lenses", {}).items()},
                dropped=stored["dropped"],
                points_recon=arrays["points_recon"],
                colors_srgb=arrays["colors_srgb"],
                observations=arrays["observations"],
                reprojection_error_px=stored["reprojection_error_px"],
                figures=stored["figures"],
            )
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise MalformedFileError(
            path, f"does not hold a structure ({error})", "run the stage again"
        ) from error


def _camera_json(camera: Camera) -> dict[str, object]:
    return {
        "fx": float(camera.fx),
        "fy": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "width": int(camera.width),
        "height": int(camera.height),
        "T_world_cam": camera.T_world_cam.tolist(),
    }
