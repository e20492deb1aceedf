"""Scans as written by other programs, made from images with known cameras."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from aomgen.core.camera import look_at
from aomgen.core.transforms import invert, quat_from_matrix

# Camera axes of OpenGL (x right, y up, z backward) from OpenCV's.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class KnownScan:
    """Images of one pinhole camera, and their poses T_scan_cam."""

    images: tuple[Path, ...]
    poses: tuple[np.ndarray, ...]
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]


def known_scan(images: Sequence[Path], *, width: int, height: int) -> KnownScan:
    """Place cameras on a spiral, looking at the origin."""
    turns = np.linspace(0, 2 * np.pi, len(images), endpoint=False)
    poses = tuple(look_at((np.cos(a), np.sin(a), 0.4 + 0.1 * a), (0, 0, 0)) for a in turns)
    return KnownScan(tuple(images), poses, width, height, (600.25, 599.5, 320.125, 239.75))


def write_transforms(folder: Path, scan: KnownScan, **changes) -> Path:
    """Write nerfstudio's layout, with the camera axes of OpenGL."""
    _copy(scan, folder / "images")
    fx, fy, cx, cy = scan.intrinsics
    frames = [
        {"file_path": f"./images/{path.name}", "transform_matrix": (T @ OPENGL).tolist()}
        for path, T in zip(scan.images, scan.poses, strict=True)
    ]
    data = {"w": scan.width, "h": scan.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data | changes), "utf-8")
    return folder


def write_colmap(folder: Path, scan: KnownScan, *, text: bool, camera: pycolmap.Camera | None = None) -> Path:
    """Write COLMAP's project layout with COLMAP."""
    _copy(scan, folder / "images")
    model = pycolmap.Reconstruction()
    camera = camera or pycolmap.Camera(
        model="PINHOLE", width=scan.width, height=scan.height, params=list(scan.intrinsics)
    )
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for number, (path, T) in enumerate(zip(scan.images, scan.poses, strict=True), 1):
        image = pycolmap.Image(name=path.name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(T)[:3]))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(sparse)
    return folder


def write_polycam(folder: Path, scan: KnownScan) -> Path:
    """Write Polycam's raw data after its adjustment."""
    keyframes = folder / "keyframes"
    _copy(scan, keyframes / "corrected_images")
    (keyframes / "corrected_cameras").mkdir()
    fx, fy, cx, cy = scan.intrinsics
    for path, T in zip(scan.images, scan.poses, strict=True):
        matrix = T @ OPENGL
        data = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        data |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": scan.width, "height": scan.height}
        (keyframes / "corrected_cameras" / f"{path.stem}.json").write_text(json.dumps(data), "utf-8")
    return folder


def write_record3d(folder: Path, scan: KnownScan) -> Path:
    """Write Record3D's EXR + RGB export."""
    (folder / "rgb").mkdir(parents=True)
    poses = []
    for number, (path, T) in enumerate(zip(scan.images, scan.poses, strict=True)):
        shutil.copyfile(path, folder / "rgb" / f"{number}{path.suffix}")
        w, x, y, z = quat_from_matrix((T @ OPENGL)[:3, :3])
        poses.append([x, y, z, w, *T[:3, 3]])
    fx, fy, cx, cy = scan.intrinsics
    data = {
        "w": scan.width,
        "h": scan.height,
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "poses": poses,
        "fps": 60,
    }
    (folder / "metadata.json").write_text(json.dumps(data), "utf-8")
    return folder


def write_photos(folder: Path, scan: KnownScan) -> Path:
    """Write photos without poses."""
    _copy(scan, folder)
    return folder


def _copy(scan: KnownScan, folder: Path) -> None:
    folder.mkdir(parents=True)
    for path in scan.images:
        shutil.copyfile(path, folder / path.name)


WRITERS: dict[str, Callable[[Path, KnownScan], Path]] = {
    "transforms.json": write_transforms,
    "COLMAP text": lambda folder, scan: write_colmap(folder, scan, text=True),
    "COLMAP binary": lambda folder, scan: write_colmap(folder, scan, text=False),
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "photos": write_photos,
}
