"""Structure from rendered photographs: recovered, refused, stored and read back."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.progress import silent
from aomgen.core.recording import Intrinsics
from aomgen.core.transforms import apply, umeyama
from aomgen.errors import MalformedFileError, ReconstructionError
from aomgen.io.images import write_image
from aomgen.reconstruction.fixed_cameras import DemoView
from aomgen.reconstruction.structure import Photographs, Structure, StructureParams
from aomgen.reconstruction.structure_stage import POINTS_FILE, load_structure, run_structure, save_structure
from aomgen.splatting.rasterizer import render

INTRINSICS = Intrinsics(fx=320.0, fy=320.0, cx=160.0, cy=120.0)


def _scene() -> Gaussians:
    """A corner of three boards with different prints, as small flat Gaussians."""
    rng = np.random.default_rng(3)
    sheets = []
    for axis in range(3):
        u, v = np.meshgrid(np.linspace(0, 1.6, 150), np.linspace(0, 1.6, 150))
        points = np.insert(np.stack([u.ravel(), v.ravel()], 1), axis, 0.0, axis=1)
        print_ = ndimage.gaussian_filter(rng.random((150, 150, 3)), (1.2, 1.2, 0))
        print_ = (print_ - print_.min()) / np.ptp(print_)
        sheets.append((points, print_.reshape(-1, 3)))
    points = np.concatenate([sheet[0] for sheet in sheets])
    colors = np.concatenate([sheet[1] for sheet in sheets])
    count = len(points)
    return Gaussians(
        means=points,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 0.007),
        opacities=np.full(count, 0.95),
        sh=((colors - 0.5) / SH_C0)[:, None],
    )


def _run(images, folder, *, intrinsics=INTRINSICS, demo=None, params=None) -> Structure:
    photographs = Photographs(images=images, intrinsics=intrinsics, demo=demo or {})
    return run_structure(photographs, {}, folder, silent, params)


def _camera(angle: float, height: float) -> Camera:
    eye = [0.6 + 2.2 * np.cos(angle), 0.6 + 2.2 * np.sin(angle), height]
    T = look_at(eye, [0.5, 0.5, 0.5])
    return Camera(fx=320.0, fy=320.0, cx=160.0, cy=120.0, width=320, height=240, T_world_cam=T)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> tuple[dict[str, Path], dict[str, Camera], DemoView, Camera]:
    """Twelve images on disk with their cameras, and a fixed camera's view with its camera."""
    folder, scene = tmp_path_factory.mktemp("scan"), _scene()

    def photograph(camera: Camera) -> np.ndarray:
        return (np.clip(render(scene, camera).rgb, 0, 1) * 255).astype(np.uint8)

    cameras = {f"{i:02d}.png": _camera(0.25 + 0.09 * i, 1.1 + 0.3 * (i % 2)) for i in range(12)}
    for name, camera in cameras.items():
        write_image(folder / name, photograph(camera))
    fixed = _camera(0.7, 1.6)
    view = DemoView(first_srgb=photograph(fixed), median_srgb=photograph(fixed), intrinsics=INTRINSICS)
    return {name: folder / name for name in cameras}, cameras, view, fixed


def test_cameras_and_the_fixed_camera_are_recovered_and_read_back(photographs, tmp_path):
    images, cameras, view, fixed = photographs
    made = _run(images, tmp_path, demo={"front": view})
    structure = load_structure(tmp_path)
    assert list(structure.cameras_recon) == sorted(images)
    assert structure.dropped == {}
    assert structure.reprojection_error_px < 1.0
    assert np.array_equal(structure.observations, made.observations)
    found = np.array([camera.center for camera in structure.cameras_recon.values()])
    true = np.array([camera.center for camera in cameras.values()])
    S = umeyama(found, true)
    assert np.linalg.norm(apply(S, found) - true, axis=1).max() < 0.01
    assert np.linalg.norm(apply(S, structure.demo_cameras_recon["front"].center) - fixed.center) < 0.01
    on_board = np.abs(apply(S, structure.points_recon)).min(1)
    # The boards are a Gaussian thick, and an arc of cameras holds the far side loosely.
    assert np.median(on_board) < 0.04


def test_too_few_images_are_refused(photographs, tmp_path):
    images, *_ = photographs
    with pytest.raises(ReconstructionError, match="at least 8"):
        _run(dict(list(images.items())[:5]), tmp_path)


def test_images_of_nothing_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    images = {}
    for index in range(8):
        images[f"{index}.png"] = tmp_path / f"{index}.png"
        write_image(images[f"{index}.png"], rng.integers(0, 255, (120, 160, 3)).astype(np.uint8))
    with pytest.raises(ReconstructionError, match="scan"):
        _run(images, tmp_path, intrinsics=None, params=StructureParams(max_features=500))


def test_a_fixed_camera_that_shows_something_else_is_refused(photographs, tmp_path):
    images, *_ = photographs
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    view = DemoView(first_srgb=noise, median_srgb=noise, intrinsics=INTRINSICS)
    with pytest.raises(ReconstructionError, match="front"):
        _run(images, tmp_path, demo={"front": view}, params=StructureParams(max_features=1500))


def test_a_damaged_structure_is_named(tmp_path):
    structure = Structure(
        cameras_recon={"00.png": _camera(0.3, 1.0)},
        demo_cameras_recon={},
        dropped={"01.png": "not registered"},
        points_recon=np.zeros((2, 3)),
        colors_srgb=np.zeros((2, 3), np.uint8),
        observations=np.zeros((2, 2), np.int32),
        reprojection_error_px=0.5,
    )
    save_structure(structure, tmp_path)
    assert load_structure(tmp_path).dropped == structure.dropped
    (tmp_path / POINTS_FILE).write_bytes(b"PK not a zip")
    with pytest.raises(MalformedFileError, match=r"points\.npz"):
        load_structure(tmp_path)
