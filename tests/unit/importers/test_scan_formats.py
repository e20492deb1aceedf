"""Each format of a scan is recognised and read back as it was written."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from aomgen.capture.scan_poses import SCAN_POSES_FILE, read_scan_poses
from aomgen.core.progress import silent
from aomgen.errors import SeveralCamerasError
from aomgen.importers.scan_import import import_scan
from aomgen.importers.scan_source import ScanImage, ScanSource
from aomgen.importers.scan_writing import WrittenScan, write_scan
from aomgen.io.images import read_image, resize, write_image
from aomgen.io.video import encode_video
from foreign_scans import WRITERS, KnownScan, known_scan, write_colmap, write_polycam, write_transforms

POSED = [name for name in WRITERS if name != "photos"]


def bring(source: Path, capture: Path, long_side: int = 0) -> WrittenScan:
    return import_scan(source, capture, long_side, silent)[1]


@pytest.mark.parametrize("kind", POSED)
def test_posed_scan_comes_back(kind: str, few: KnownScan, tmp_path: Path) -> None:
    done = bring(WRITERS[kind](tmp_path / "source", few), tmp_path / "capture")
    scan = tmp_path / "capture" / "scan"
    poses = read_scan_poses(scan / SCAN_POSES_FILE)
    assert poses.metric == (kind in ("Polycam", "Record3D"))
    assert len(done.names) == len(few.images)
    for name, path, T in zip(done.names, few.images, few.poses, strict=True):
        assert (scan / name).read_bytes() == path.read_bytes()
        np.testing.assert_allclose(poses.Ts_scan_cam[name], T, atol=1e-6)
    found = done.intrinsics
    assert found is not None
    assert (found.fx, found.fy, found.cx, found.cy) == few.intrinsics


def test_names_with_dots_stay_apart(few: KnownScan, tmp_path: Path) -> None:
    path = write_transforms(tmp_path / "source", few) / "transforms.json"
    text = path.read_text("utf-8")
    for number, image in enumerate(few.images):
        name = f"frame.{number:04d}"
        found = next(path.parent.rglob(image.name))
        found.rename(found.with_name(name + image.suffix))
        text = text.replace(image.name, name)
    path.write_text(text, "utf-8")
    done = bring(path.parent, tmp_path / "capture")
    assert list(done.names) == [
        f"frame.{number:04d}{image.suffix}" for number, image in enumerate(few.images)
    ]


def test_images_whose_names_differ_only_in_the_suffix_stay_apart(few: KnownScan, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    image = resize(read_image(few.images[0]), 16, 12)
    images = [
        ScanImage(name=f"a{suffix}", path=source / f"{number}.png", camera=None, T_scan_cam=None)
        for number, suffix in enumerate([".bmp", ".BMP", ".bmp", ".jpg", ".png"])
    ]
    for number, item in enumerate(images):
        write_image(item.path, image + np.uint8(number))
    folder = tmp_path / "scan"
    folder.mkdir()
    done = write_scan(ScanSource(kind="", images=tuple(images), warnings=()), folder, 0, source, silent)
    assert done.names == ("a.jpg", "a_bmp.jpg", "a_bmp_2.jpg", "a_jpg.jpg", "a.png")
    assert {path.name for path in folder.iterdir()} == set(done.names)


def test_photos_have_no_poses(few: KnownScan, tmp_path: Path) -> None:
    done = bring(WRITERS["photos"](tmp_path / "source", few), tmp_path / "capture")
    scan = tmp_path / "capture" / "scan"
    assert sorted(path.name for path in scan.iterdir()) == [path.name for path in few.images]
    assert done.poses is None
    assert done.intrinsics is None
    for path in few.images:
        assert (scan / path.name).read_bytes() == path.read_bytes()


def test_large_images_are_reduced_with_their_optics(few: KnownScan, tmp_path: Path) -> None:
    done = bring(write_transforms(tmp_path / "source", few), tmp_path / "capture", long_side=320)
    found = done.intrinsics
    assert found is not None
    assert (done.width, done.height) == (320, 240)
    np.testing.assert_allclose(
        (found.fx, found.fy, found.cx, found.cy), np.array(few.intrinsics) / 2, rtol=1e-12
    )
    assert read_image(tmp_path / "capture" / "scan" / done.names[0]).shape == (240, 320, 3)


def paint(rays: np.ndarray) -> np.ndarray:
    """A smooth image (N, 3) uint8 of viewing directions (N, 2)."""
    waves = np.stack([rays @ (9, 4), rays @ (-5, 7), rays @ (3, -8)], 1)
    return np.round(127.5 + 100 * np.sin(waves)).astype(np.uint8)


# Optics at 160 x 120.
LENSES = {
    "SIMPLE_RADIAL": [150, 80, 60, -0.1],
    "RADIAL": [150, 80, 60, -0.1, 0.02],
    "OPENCV": [150, 152, 79, 61, 0.1, -0.05, 0.002, -0.001],
    "FULL_OPENCV": [150, 152, 79, 61, 0.1, -0.05, 0.002, -0.001, 0.01, 0.0, 0.0, 0.0],
    "FOV": [150, 150, 80, 60, 0.4],
    "OPENCV_FISHEYE": [100, 101, 80, 60, 0.02, -0.01, 0.0, 0.0],
    "THIN_PRISM_FISHEYE": [150, 150, 80, 60, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.001, 0.001],
    "SIMPLE_DIVISION": [150, 80, 60, -0.1],
    "EUCM": [150, 150, 80, 60, 0.5, 1.0],
}


def photograph(folder: Path, cameras: list[pycolmap.Camera]) -> KnownScan:
    """Images that lenses make of directions."""
    folder.mkdir()
    paths = []
    for index, camera in enumerate(cameras):
        u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
        rays = np.asarray(camera.cam_from_img(np.column_stack([u.ravel(), v.ravel()])))
        paths.append(folder / f"{index:03d}.png")
        write_image(paths[-1], paint(rays).reshape(120, 160, 3))
    return known_scan(paths, width=160, height=120)


@pytest.mark.parametrize("model", LENSES)
def test_lens_is_removed(model: str, tmp_path: Path) -> None:
    camera = pycolmap.Camera(model=model, width=160, height=120, params=LENSES[model])
    scan = photograph(tmp_path / "images", [camera] * 12)
    done = bring(write_colmap(tmp_path / "source", scan, text=False, camera=camera), tmp_path / "capture")
    check_painted(done, tmp_path / "capture" / "scan")
    assert done.resampled == 12


def check_painted(done: WrittenScan, folder: Path) -> None:
    """Every image shows what a pinhole camera of the stated intrinsics would, with at least 40 dB."""
    found = done.intrinsics
    assert found is not None
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = np.column_stack([(u.ravel() - found.cx) / found.fx, (v.ravel() - found.cy) / found.fy])
    want = paint(rays).reshape(120, 160, 3).astype(float)
    for name in (done.names[0], done.names[-1]):
        error = np.mean((read_image(folder / name) - want) ** 2)
        assert 10 * np.log10(255**2 / max(error, 1e-9)) >= 40


def test_focal_lengths_that_vary_become_one(tmp_path: Path) -> None:
    cameras = [
        pycolmap.Camera(
            model="PINHOLE", width=160, height=120, params=[150 + i / 2, 150 + i / 2, 80, 60 + i / 10]
        )
        for i in range(12)
    ]
    scan = photograph(tmp_path / "images", cameras)
    source = write_polycam(tmp_path / "source", scan)
    for index, file in enumerate(sorted((source / "keyframes" / "corrected_cameras").iterdir())):
        fx, fy, cx, cy = cameras[index].params
        text = file.read_text("utf-8")
        for key, old, new in zip(("fx", "fy", "cx", "cy"), scan.intrinsics, (fx, fy, cx, cy), strict=True):
            text = text.replace(f'"{key}": {old}', f'"{key}": {new}')
        file.write_text(text, "utf-8")
    check_painted(bring(source, tmp_path / "capture"), tmp_path / "capture" / "scan")


def test_optics_of_frames_win_over_those_of_the_file(few: KnownScan, tmp_path: Path) -> None:
    source = write_transforms(tmp_path / "source", few, fl_x=1000.0)
    text = (source / "transforms.json").read_text("utf-8")
    path = source / "transforms.json"
    path.write_text(text.replace('{"file_path"', '{"fl_x": 600.25, "file_path"'), "utf-8")
    found = bring(source, tmp_path / "capture").intrinsics
    assert found is not None
    assert found.fx == 600.25


def test_field_of_view_gives_the_focal_length(few: KnownScan, tmp_path: Path) -> None:
    angle = 2 * np.arctan(320 / 500)
    source = write_transforms(tmp_path / "source", few, fl_x=None, fl_y=None, camera_angle_x=angle)
    found = bring(source, tmp_path / "capture").intrinsics
    assert found is not None
    assert found.fx == pytest.approx(500)


def test_two_zooms_are_refused(few: KnownScan, tmp_path: Path) -> None:
    source = write_polycam(tmp_path / "source", few)
    file = next((source / "keyframes" / "corrected_cameras").iterdir())
    file.write_text(file.read_text("utf-8").replace('"fx": 600.25', '"fx": 1200.0'), "utf-8")
    with pytest.raises(SeveralCamerasError, match="focal length") as caught:
        bring(source, tmp_path / "capture")
    assert sum(len(names) for names in caught.value.groups.values()) == 12


def test_frames_of_a_video_are_sampled(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wide = np.kron(rng.integers(0, 255, (30, 160, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    frames = [wide[:, 8 * k : 8 * k + 320] for k in range(100)]
    (tmp_path / "walk.mp4").write_bytes(encode_video(frames, 30))
    done = bring(tmp_path / "walk.mp4", tmp_path / "capture")
    assert 12 <= len(done.names) <= 100
    assert done.names[0].startswith("scan_")
    assert (done.width, done.height) == (320, 240)
