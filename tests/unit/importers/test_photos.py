"""Photos as phones write them: EXIF orientation and focal length, HEIC, turned cameras."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from aomgen.core.progress import silent
from aomgen.errors import BackendError, IncompleteCaptureError, MalformedFileError, SeveralCamerasError
from aomgen.importers.photos import DIAGONAL_35MM, EXIF_BLOCK, FOCAL_35MM
from aomgen.importers.scan_import import import_scan
from aomgen.importers.scan_writing import WrittenScan
from aomgen.io.images import EXIF_ORIENTATION, read_image, resize
from foreign_scans import KnownScan, write_photos
from heic_file import heic_bytes


def bring(source: Path, capture: Path) -> WrittenScan:
    return import_scan(source, capture, 0, silent)[1]


def set_exif(path: Path, *, orientation: int = 1, focal_35mm: int = 0) -> None:
    with Image.open(path) as image:
        exif = image.getexif()
        exif[EXIF_ORIENTATION] = orientation
        if focal_35mm:
            exif.get_ifd(EXIF_BLOCK)[FOCAL_35MM] = focal_35mm
        image.save(path, quality=95, exif=exif)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def test_photos_become_upright(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    for path in source.iterdir():
        set_exif(path, orientation=6)
    done = bring(source, tmp_path / "capture")
    assert (done.width, done.height) == (480, 640)
    for name in done.names:
        have = tmp_path / "capture" / "scan" / name
        with Image.open(have) as image:
            assert image.size == (480, 640)
            assert image.getexif().get(EXIF_ORIENTATION, 1) == 1
    assert psnr(read_image(have), read_image(source / name)) >= 40


def test_focal_length_of_exif_is_used(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    for path in source.iterdir():
        set_exif(path, focal_35mm=26)
    found = bring(source, tmp_path / "capture").intrinsics
    assert found is not None
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx(
        (26 / DIAGONAL_35MM * 800, 26 / DIAGONAL_35MM * 800, 320, 240)
    )


def test_focal_length_that_some_photos_state_is_not_used(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    set_exif(source / few.images[0].name, focal_35mm=26)
    assert bring(source, tmp_path / "capture").intrinsics is None


def test_two_lenses_are_refused(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    for index, path in enumerate(sorted(source.iterdir())):
        set_exif(path, focal_35mm=13 if index == 4 else 26)
    with pytest.raises(SeveralCamerasError, match="2 cameras") as caught:
        bring(source, tmp_path / "capture")
    assert [len(names) for names in caught.value.groups.values()] == [11, 1]


def test_photos_of_a_turned_camera_are_stored_alike(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    turned = source / few.images[3].name
    set_exif(turned, orientation=8, focal_35mm=26)
    for path in source.iterdir():
        if path != turned:
            set_exif(path, focal_35mm=26)
    done = bring(source, tmp_path / "capture")
    assert (done.width, done.height) == (640, 480)
    assert "1 of 12 photos" in done.warnings[0]
    assert turned.name in done.warnings[0]
    have = read_image(tmp_path / "capture" / "scan" / turned.name)
    assert psnr(have, np.rot90(read_image(turned))) >= 40


def test_several_sizes_are_refused(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    Image.fromarray(np.zeros((300, 400, 3), np.uint8)).save(source / "small.png")
    with pytest.raises(SeveralCamerasError, match="400 x 300") as caught:
        bring(source, tmp_path / "capture")
    assert caught.value.groups["400 x 300 px"] == ["small.png"]


def write_heic(folder: Path, scan: KnownScan, **options) -> Path:
    """One image, twelve times: encoding takes long."""
    folder.mkdir()
    data = heic_bytes(resize(read_image(scan.images[0]), 160, 120), **options)
    for path in scan.images:
        (folder / f"{path.stem}.HEIC").write_bytes(data)
    return folder


def test_heic(few: KnownScan, tmp_path: Path) -> None:
    pytest.importorskip("pi_heif", reason="extra heic is not installed")
    done = bring(write_heic(tmp_path / "source", few), tmp_path / "capture")
    assert list(done.names) == [f"{path.stem}.jpg" for path in few.images]
    for name in done.names:
        # HEVC halves the resolution of colors.
        want = resize(read_image(few.images[0]), 160, 120)
        assert psnr(read_image(tmp_path / "capture" / "scan" / name), want) >= 34


def test_heic_is_upright(few: KnownScan, tmp_path: Path) -> None:
    pytest.importorskip("pi_heif", reason="extra heic is not installed")
    done = bring(write_heic(tmp_path / "source", few, quarter_turns=1), tmp_path / "capture")
    name = done.names[0]
    have = read_image(tmp_path / "capture" / "scan" / name)
    assert psnr(have, np.rot90(resize(read_image(few.images[0]), 160, 120))) >= 34


def test_jpeg_beside_heic_is_taken(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    (source / f"{few.images[0].stem}.heic").write_bytes(b"not read")
    assert len(bring(source, tmp_path / "capture").names) == 12


def test_heic_without_the_extra(few: KnownScan, tmp_path: Path, monkeypatch) -> None:
    source = write_photos(tmp_path / "source", few)
    (source / "more.heic").write_bytes(b"")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BackendError, match=r"pip install 'aomgen\[heic\]'") as caught:
        bring(source, tmp_path / "capture")
    assert caught.value.exit_code == 4
    assert not (tmp_path / "capture").exists()


def test_damaged_photo_is_named(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    victim = source / few.images[7].name
    victim.write_bytes(victim.read_bytes()[:5000])
    with pytest.raises(MalformedFileError, match=victim.name):
        bring(source, tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_other_formats_are_named(few: KnownScan, tmp_path: Path) -> None:
    source = write_photos(tmp_path / "source", few)
    (source / "raw.dng").write_bytes(b"")
    with pytest.raises(MalformedFileError, match=r"raw.dng: is neither JPEG nor PNG nor HEIC"):
        bring(source, tmp_path / "capture")


def test_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    with pytest.raises(IncompleteCaptureError, match="holds no photos"):
        bring(tmp_path / "source", tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_few_photos(few: KnownScan, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for path in few.images[:5]:
        shutil.copyfile(path, source / path.name)
    with pytest.raises(IncompleteCaptureError, match="holds 5 images, at least 12"):
        bring(source, tmp_path / "capture")
