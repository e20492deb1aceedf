"""Damaged scans give typed errors or a scan, and leave nothing half-written."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from aomgen.core.progress import silent
from aomgen.errors import AomgenError
from aomgen.importers.scan_import import import_scan
from aomgen.io.images import write_image
from foreign_scans import WRITERS, KnownScan, known_scan
from heic_file import heic_bytes

# Small images, so that hundreds of imports take seconds.
SIZE = (48, 32)
ROUNDS = 12


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> KnownScan:
    folder, rng = tmp_path_factory.mktemp("small"), np.random.default_rng(0)
    for index in range(12):
        write_image(folder / f"{index:03d}.jpg", rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8))
    scan = known_scan(sorted(folder.iterdir()), width=SIZE[0], height=SIZE[1])
    return KnownScan(scan.images, scan.poses, *SIZE, (45.0, 45.0, 24.0, 16.0))


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes cut off, or with some bits flipped, or with a part replaced by noise."""
    kind, at = rng.integers(3), int(rng.integers(max(1, len(data))))
    if kind == 0:
        return data[:at]
    noisy = np.frombuffer(data, np.uint8).copy()
    if kind == 1:
        places = rng.integers(0, len(noisy), 4)
        noisy[places] ^= (1 << rng.integers(0, 8, 4)).astype(np.uint8)
    else:
        noisy[at : at + 16] = rng.integers(0, 256, len(noisy[at : at + 16]))
    return noisy.tobytes()


def try_import(source: Path, capture: Path) -> None:
    refusal = None
    try:
        import_scan(source, capture, 0, silent)
    except AomgenError as error:
        refusal = str(error)
    if refusal is None:
        assert sorted(path.name for path in capture.iterdir()) == ["capture.toml", "scan"]
        shutil.rmtree(capture)
    else:
        assert "\n" not in refusal
        assert not capture.exists()
    assert not list(capture.parent.glob(".staging-*"))


@pytest.mark.parametrize("kind", WRITERS)
def test_damaged_files(kind: str, small: KnownScan, tmp_path: Path) -> None:
    source = WRITERS[kind](tmp_path / "source", small)
    files = sorted(path for path in source.rglob("*") if path.is_file())
    # Descriptions first: there is one of them for many images.
    chosen = [path for path in files if path.suffix != ".jpg"][:3] + [files[-1]]
    for index, path in enumerate(chosen):
        good, rng = path.read_bytes(), np.random.default_rng(index)
        for _ in range(ROUNDS):
            path.write_bytes(damage(good, rng))
            try_import(source, tmp_path / "capture")
        path.write_bytes(good)


def test_damaged_heic(small: KnownScan, tmp_path: Path) -> None:
    pytest.importorskip("pi_heif", reason="extra heic is not installed")
    source = WRITERS["photos"](tmp_path / "source", small)
    good = heic_bytes(np.random.default_rng(1).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8))
    rng = np.random.default_rng(2)
    for _ in range(4 * ROUNDS):
        (source / "more.heic").write_bytes(damage(good, rng))
        try_import(source, tmp_path / "capture")
