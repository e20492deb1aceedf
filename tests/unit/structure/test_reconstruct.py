"""Structure from rendered photographs: recovered, refused, stored and read back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians
from aomgen.core.lens import Lens
from aomgen.core.progress import silent
from aomgen.core.recording import Intrinsics
from aomgen.core.structure import Structure
from aomgen.core.transforms import apply, matrix_from_rotvec, transform
from aomgen.errors import ReconstructionError
from aomgen.io.images import read_image, write_image
from aomgen.splatting.rasterizer import render
from aomgen.structure.fixed_cameras import DemoView
from aomgen.structure.mapping import Workspace
from aomgen.structure.outlier_rejection import InlierModel, is_better
from aomgen.structure.reconstruct import Photographs, StructureParams, reconstruct_structure
from aomgen.structure.sparse_model import SparseModel
from aomgen.structure.stage import list_pose_warnings
from similarity_fit import best_similarity

# Enough for boards full of print; images that are not doubled need a third of the time.
FEW_FEATURES = StructureParams(max_features=1000, first_octave=0)
# For tests that need matches between all images.
MORE_FEATURES = StructureParams(max_features=1000)
INTRINSICS = Intrinsics(fx=320.0, fy=320.0, cx=160.0, cy=120.0)


def _scene(seed: int = 3) -> Gaussians:
    """A corner of three boards with different prints, as small flat Gaussians."""
    rng = np.random.default_rng(seed)
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


def _run(
    images: dict[str, Path],
    *,
    intrinsics: Intrinsics | None = INTRINSICS,
    demo: dict[str, DemoView] | None = None,
    params: StructureParams = FEW_FEATURES,
    poses: dict[str, np.ndarray] | None = None,
) -> Structure:
    photographs = Photographs(images=images, intrinsics=intrinsics, demo=demo or {}, Ts_scan_cam=poses or {})
    return reconstruct_structure(photographs, params, silent)


def _camera(angle: float, height: float) -> Camera:
    eye = [0.6 + 2.2 * np.cos(angle), 0.6 + 2.2 * np.sin(angle), height]
    T = look_at(eye, [0.5, 0.5, 0.5])
    return Camera(fx=320.0, fy=320.0, cx=160.0, cy=120.0, width=320, height=240, T_world_cam=T)


def _photograph(scene: Gaussians, camera: Camera) -> np.ndarray:
    return (np.clip(render(scene, camera).rgb, 0, 1) * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> tuple[dict[str, Path], dict[str, Camera], DemoView, Camera]:
    """Twelve images on disk with their cameras, and a fixed camera's view with its camera."""
    folder, scene = tmp_path_factory.mktemp("scan"), _scene()

    def photograph(camera: Camera) -> np.ndarray:
        return _photograph(scene, camera)

    cameras = {f"{i:02d}.png": _camera(0.25 + 0.09 * i, 1.1 + 0.3 * (i % 2)) for i in range(12)}
    for name, camera in cameras.items():
        write_image(folder / name, photograph(camera))
    fixed = _camera(0.7, 1.6)
    view = DemoView(first_srgb=photograph(fixed), median_srgb=photograph(fixed), intrinsics=INTRINSICS)
    return {name: folder / name for name in cameras}, cameras, view, fixed


def test_cameras_and_the_fixed_camera_are_recovered(photographs):
    images, cameras, view, fixed = photographs
    structure = _run(images, demo={"front": view})
    assert list(structure.cameras_recon) == sorted(images)
    assert structure.dropped == {}
    assert structure.reprojection_error_px < 1.0
    found = np.array([camera.center for camera in structure.cameras_recon.values()])
    true = np.array([camera.center for camera in cameras.values()])
    S = best_similarity(found, true)
    assert np.linalg.norm(apply(S, found) - true, axis=1).max() < 0.01
    assert np.linalg.norm(apply(S, structure.demo_cameras_recon["front"].center) - fixed.center) < 0.01
    assert structure.figures["demo_cameras"]["front"]["used"] == ["first", "median"]
    on_board = np.abs(apply(S, structure.points_recon)).min(1)
    # The boards are a Gaussian thick, and an arc of cameras holds the far side loosely.
    assert np.median(on_board) < 0.04


def _errors(structure: Structure, cameras: dict[str, Camera]) -> np.ndarray:
    names = [name for name in structure.cameras_recon if name in cameras]
    found = np.array([structure.cameras_recon[name].center for name in names])
    true = np.array([cameras[name].center for name in names])
    return np.linalg.norm(apply(best_similarity(found, true), found) - true, axis=1)


@pytest.mark.slow
def test_foreign_and_repeated_images_are_listed_and_unused(photographs, tmp_path):
    images, cameras, view, _ = photographs
    elsewhere = _scene(8)
    images = dict(images)
    for name, angle in (("foreign0.png", 0.4), ("foreign1.png", 0.5)):
        images[name] = tmp_path / name
        write_image(images[name], _photograph(elsewhere, _camera(angle, 1.2)))
    again = tmp_path / "again.jpg"
    write_image(again, read_image(images["05.png"]))
    images["again.jpg"] = again
    structure = _run(images, demo={"front": view}, params=MORE_FEATURES)
    assert set(structure.dropped) == {"foreign0.png", "foreign1.png", "again.jpg"}
    assert "shows the same as" in structure.dropped["again.jpg"]
    assert "too few matches" in structure.dropped["foreign0.png"]
    assert _errors(structure, cameras).max() < 0.01
    assert set(structure.figures["tried"]) == {"incremental", "global"}


def test_repeated_images_of_few_viewpoints_are_refused(photographs, tmp_path):
    images, *_ = photographs
    few = {f"{i}{name}": path for name, path in list(images.items())[:4] for i in range(3)}
    with pytest.raises(ReconstructionError, match="12 images, 8 of them twice"):
        _run(few)


def _given_poses(cameras: dict[str, Camera], error_deg: float = 0.0) -> dict[str, np.ndarray]:
    """Poses in another frame and unit, each turned by a small angle."""
    rng = np.random.default_rng(2)
    T_scan_world = transform(matrix_from_rotvec([0.3, -0.5, 0.2]), [4.0, -2.0, 1.0])
    poses = {}
    for name, camera in cameras.items():
        turn = rng.normal(size=3)
        turn *= np.radians(error_deg) / np.linalg.norm(turn)
        poses[name] = T_scan_world @ camera.T_world_cam @ transform(matrix_from_rotvec(turn), [0, 0, 0])
        poses[name][:3, 3] *= 3.0
    return poses


def _no_mapping(work: Workspace, group: str):
    raise AssertionError("images were mapped although their poses are known")


def test_given_poses_replace_mapping(photographs, monkeypatch):
    images, cameras, *_ = photographs
    monkeypatch.setattr(Workspace, "map", _no_mapping)
    monkeypatch.setattr(Workspace, "map_globally", _no_mapping)
    structure = _run(images, poses=_given_poses(cameras, error_deg=0.4))
    assert structure.figures["mapper"] == "given poses"
    assert structure.figures["given_poses"] == {"used": 12, "contradicted": {}, "warnings": []}
    assert structure.dropped == {}
    assert _errors(structure, cameras).max() < 0.01


def test_contradicted_and_missing_poses_are_estimated(photographs):
    images, cameras, *_ = photographs
    poses = _given_poses(cameras)
    poses["03.png"], poses["08.png"] = poses["08.png"], poses["03.png"]
    del poses["10.png"]
    structure = _run(images, poses=poses)
    assert structure.figures["mapper"] == "given poses"
    given = structure.figures["given_poses"]
    assert given["used"] == 9
    assert set(given["contradicted"]) == {"03.png", "08.png"}
    (warning,) = list_pose_warnings(structure)
    assert "2 of 11 poses" in warning
    assert "03.png, 08.png" in warning
    assert structure.dropped == {}
    assert _errors(structure, cameras).max() < 0.01


@pytest.mark.slow
def test_poses_of_other_axes_are_not_used(photographs):
    images, cameras, *_ = photographs
    poses = {name: T @ np.diag([1.0, -1.0, -1.0, 1.0]) for name, T in _given_poses(cameras).items()}
    # With fewer features some images have too few matches to contradict a pose.
    structure = _run(images, poses=poses, params=MORE_FEATURES)
    assert structure.figures["mapper"] == "incremental"
    assert structure.figures["given_poses"]["used"] == 0
    assert "all images are mapped" in list_pose_warnings(structure)[0]
    assert _errors(structure, cameras).max() < 0.01


def _half_blind(images: dict[str, Path]):
    """Incremental mapping that stops when it has half of the images."""
    real = Workspace.map

    def stopped(work: Workspace, group: str):
        files = dict(work._files[group])
        work.leave_out(group, set(sorted(files)[len(files) // 2 :]))
        try:
            return real(work, group)
        finally:
            work._files[group] = files

    return stopped


@pytest.mark.slow
def test_global_mapping_helps_where_incremental_mapping_stops(photographs, tmp_path, monkeypatch):
    images, cameras, view, _ = photographs
    monkeypatch.setattr(Workspace, "map", _half_blind(images))
    structure = _run(images, demo={"front": view, "side": view})
    assert structure.figures["mapper"] == "global"
    assert structure.figures["tried"]["incremental"]["registered"] == 6
    assert structure.dropped == {}
    assert _errors(structure, cameras).max() < 0.01
    assert set(structure.demo_cameras_recon) == {"front", "side"}


def test_global_mapping_finds_the_focal_length(photographs, tmp_path, monkeypatch):
    images, cameras, view, _ = photographs
    monkeypatch.setattr(Workspace, "map", lambda work, group: None)
    demo = {"front": replace(view, intrinsics=None)}
    structure = _run(images, intrinsics=None, demo=demo)
    assert structure.figures["mapper"] == "global"
    scan = next(iter(structure.cameras_recon.values()))
    assert scan.fx == pytest.approx(320, rel=0.02)
    # The fixed camera's images have the scan's size, and nothing says that it is another camera.
    assert structure.demo_cameras_recon["front"].fx == scan.fx
    assert _errors(structure, cameras).max() < 0.03


def test_a_result_of_half_the_images_is_refused(photographs, tmp_path, monkeypatch):
    images, *_ = photographs
    monkeypatch.setattr(Workspace, "map", _half_blind(images))
    monkeypatch.setattr(Workspace, "map_globally", _half_blind(images))
    with pytest.raises(ReconstructionError, match=r"6 of 12 images"):
        _run(images)


def _inlier_model(count: int, error_px: float) -> InlierModel:
    mapped = SparseModel(
        Ts_recon_cam={str(i): np.eye(4) for i in range(count)},
        lens=Lens(fx=1, fy=1, cx=1, cy=1, width=2, height=2),
        points_recon=np.zeros((0, 3)),
        colors_srgb=np.zeros((0, 3), np.uint8),
        observations=[],
        point_of_feature={},
        error_px=error_px,
    )
    return InlierModel(mapped=mapped, dropped={"0": "wrong"}, worst_agreement=1.0)


def test_more_images_win_then_less_error_and_never_one_beyond_the_limit():
    assert is_better(_inlier_model(10, 1.0), _inlier_model(9, 0.5), 1.5)
    assert is_better(_inlier_model(10, 0.4), _inlier_model(10, 0.5), 1.5)
    assert not is_better(_inlier_model(10, 0.5), _inlier_model(10, 0.5), 1.5)
    assert not is_better(_inlier_model(10, 1.6), _inlier_model(2, 0.5), 1.5)
    assert is_better(_inlier_model(2, 0.5), _inlier_model(10, float("nan")), 1.5)


def test_too_few_images_are_refused(photographs):
    images, *_ = photographs
    with pytest.raises(ReconstructionError, match="at least 8"):
        _run(dict(list(images.items())[:5]))


def test_images_of_nothing_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    images = {}
    for index in range(8):
        images[f"{index}.png"] = tmp_path / f"{index}.png"
        write_image(images[f"{index}.png"], rng.integers(0, 255, (120, 160, 3)).astype(np.uint8))
    with pytest.raises(ReconstructionError, match="scan"):
        _run(images, intrinsics=None, params=StructureParams(max_features=500, first_octave=0))


def test_a_fixed_camera_that_shows_something_else_is_refused(photographs, tmp_path):
    images, *_ = photographs
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    view = DemoView(first_srgb=noise, median_srgb=noise, intrinsics=INTRINSICS)
    with pytest.raises(ReconstructionError, match="front"):
        _run(images, demo={"front": view})
