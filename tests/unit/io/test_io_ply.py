"""Gaussians to PLY and back, and files that must be refused."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians
from aomgen.errors import InputError, LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io.ply import read_gaussians, write_gaussians


def make_gaussians(count: int = 17, degree: int = 2, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        opacities=rng.uniform(0.01, 0.99, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    write_gaussians(path, make_gaussians())
    return path


def replace_bytes(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path: Path, degree: int) -> None:
    want = make_gaussians(degree=degree)
    write_gaussians(tmp_path / "a.ply", want)
    have = read_gaussians(tmp_path / "a.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(have, name), getattr(want, name), rtol=2e-5, atol=1e-6)


def test_reference_layout(file: Path) -> None:
    """Red's higher coefficients come first, then green's: the 3DGS order, not ours."""
    want = make_gaussians()
    data = file.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    row = np.frombuffer(data[start:], "<f4").reshape(len(want), -1)[3]
    np.testing.assert_array_equal(row[:3], want.means[3])
    np.testing.assert_array_equal(row[9:17], want.sh[3, 1:, 0])
    np.testing.assert_allclose(row[-8], np.log(want.opacities[3] / (1 - want.opacities[3])), rtol=1e-5)


def test_extremes_are_written_finite(tmp_path: Path) -> None:
    g = make_gaussians(2)
    hard = Gaussians(means=g.means, quats=g.quats, scales=[[0, 1, 1]] * 2, opacities=[0, 1], sh=g.sh)  # pyright: ignore
    write_gaussians(tmp_path / "a.ply", hard)
    np.testing.assert_allclose(read_gaussians(tmp_path / "a.ply").opacities, [0, 1], atol=1e-6)


def test_big_endian(file: Path) -> None:
    data = file.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    swapped = np.frombuffer(data[start:], "<f4").astype(">f4").tobytes()
    file.write_bytes(data[:start].replace(b"little", b"big") + swapped)
    np.testing.assert_array_equal(read_gaussians(file).means, make_gaussians().means)


def test_no_gaussians(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", make_gaussians(0))
    assert len(read_gaussians(tmp_path / "a.ply")) == 0


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        read_gaussians(tmp_path / "none.ply")


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        (b"ply\n", b"plx\n", MalformedFileError),
        (b"element vertex 17", b"element vertex 18", MalformedFileError),
        (b"element vertex 17", b"element vertex 16", MalformedFileError),
        (b"element vertex 17", b"element vertex -1", MalformedFileError),
        (b"element vertex 17", b"element vertex 99999999999", LimitExceededError),
        (b"element vertex 17", b"element face 17", MalformedFileError),
        (b"property float opacity", b"property float opacitx", MalformedFileError),
        (b"property float opacity", b"property list uchar int opacity", MalformedFileError),
        (b"property float rot_3", b"property float rot_2", MalformedFileError),
        (b"property float f_rest_7\n", b"property float other\n", MalformedFileError),
        (b"binary_little_endian", b"ascii", MalformedFileError),
        (b"end_header", b"end_headxr", MalformedFileError),
        (b"format", b"comment \xff\nformat", MalformedFileError),
    ],
)
def test_damaged_headers(file: Path, old: bytes, new: bytes, error: type[Exception]) -> None:
    replace_bytes(file, old, new)
    with pytest.raises(error):
        read_gaussians(file)


@pytest.mark.parametrize("change", [-1, -40, 1])
def test_wrong_size(file: Path, change: int) -> None:
    data = file.read_bytes()
    file.write_bytes(data[:change] if change < 0 else data + b"x" * change)
    with pytest.raises(MalformedFileError, match="bytes"):
        read_gaussians(file)


def test_every_cut_is_refused(file: Path) -> None:
    data = file.read_bytes()
    for length in range(0, len(data), 37):
        file.write_bytes(data[:length])
        with pytest.raises(InputError):
            read_gaussians(file)


@pytest.mark.parametrize(("column", "value"), [(0, np.nan), (-5, np.inf), (9, -np.inf), (-8, np.nan)])
def test_not_finite(file: Path, column: int, value: float) -> None:
    data = file.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    table = np.frombuffer(data[start:], "<f4").reshape(17, -1).copy()
    table[5, column] = value
    file.write_bytes(data[:start] + table.tobytes())
    with pytest.raises(NonFiniteError, match="Gaussian 5"):
        read_gaussians(file)


def test_zero_rotation(file: Path) -> None:
    data = file.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    table = np.frombuffer(data[start:], "<f4").reshape(17, -1).copy()
    table[4, -4:] = 0
    file.write_bytes(data[:start] + table.tobytes())
    with pytest.raises(NonFiniteError, match="Gaussian 4"):
        read_gaussians(file)
