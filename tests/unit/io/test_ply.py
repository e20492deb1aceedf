"""Gaussians to PLY and back, and files that must be refused."""

from pathlib import Path

import numpy as np
import pytest

from aomgen.core.gaussians import Gaussians
from aomgen.errors import InputError, LimitExceededError, MalformedFileError, MissingFileError, NonFiniteError
from aomgen.io.ply import BLOCK, read_gaussians, write_gaussians


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


def write_foreign(path: Path, g: Gaussians, columns: list[tuple[str, str]], order: str = "little") -> None:
    """What another program writes: any order and type of columns, and some that nobody asked for."""
    degree_rest = g.sh[:, 1:].transpose(0, 2, 1).reshape(len(g), -1)
    values = {"x": g.means[:, 0], "y": g.means[:, 1], "z": g.means[:, 2]}
    values |= {f"f_dc_{i}": g.sh[:, 0, i] for i in range(3)}
    values |= {f"f_rest_{i}": degree_rest[:, i] for i in range(degree_rest.shape[1])}
    values |= {"opacity": np.log(g.opacities / (1 - g.opacities))}
    values |= {f"scale_{i}": np.log(g.scales[:, i]) for i in range(3)}
    values |= {f"rot_{i}": 3 * g.quats[:, i] for i in range(4)}
    kinds = {"float": "f4", "double": "f8", "float32": "f4", "uchar": "u1", "int": "i4"}
    mark = {"little": "<", "big": ">"}[order]
    table = np.zeros(len(g), [(name, mark + kinds[kind]) for name, kind in columns])
    for name, _ in columns:
        table[name] = values.get(name, 7)
    lines = ["ply", f"format binary_{order}_endian 1.0", "comment end_header is still to come", "obj_info x"]
    lines += ["comment", f"element vertex {len(g)}", *(f"property {kind} {name}" for name, kind in columns)]
    path.write_bytes(("\r\n".join([*lines, "end_header"]) + "\r\n").encode() + table.tobytes())


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_files_of_others(tmp_path: Path, degree: int, order: str) -> None:
    """Rotations are not normalised, there are no normals, colors and labels stand in between."""
    want = make_gaussians(degree=degree)
    names = [f"rot_{i}" for i in (3, 0, 2, 1)] + ["x", "z", "y"] + [f"scale_{i}" for i in range(3)]
    names += [f"f_rest_{i}" for i in reversed(range(want.sh[0, 1:].size))]
    columns = [(name, ("float", "double", "float32")[i % 3]) for i, name in enumerate(names)]
    columns += [("red", "uchar"), ("opacity", "float"), ("label", "int")]
    columns += [(f"f_dc_{i}", "double") for i in range(3)]
    write_foreign(tmp_path / "a.ply", want, columns, order)
    have = read_gaussians(tmp_path / "a.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(have, name), getattr(want, name), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("before", [True, False])
def test_other_elements_are_skipped(file: Path, before: bool) -> None:
    data = file.read_bytes()
    extra, rows = b"element intrinsic 3\nproperty float value\nproperty uchar flag\n", b"z" * 15
    if before:
        data = data.replace(b"element vertex", extra + b"element vertex").replace(
            b"end_header\n", b"end_header\n" + rows
        )
    else:
        data = data.replace(b"end_header\n", extra + b"end_header\n") + rows
    file.write_bytes(data)
    np.testing.assert_array_equal(read_gaussians(file).sh, make_gaussians().sh)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            b"binary_little_endian",
            b"ascii",
            "has format ascii, expected binary_little_endian or binary_big_endian",
        ),
        (b"end_header", b"element face 0\nproperty list uchar int i\nend_header", "list in element face"),
        (b"element vertex 17", b"element chunk 17", "not one element called vertex"),
        (b"end_header", b"element vertex 0\nend_header", "not one element called vertex"),
        (b"property float scale_2\n", b"", "misses the properties scale_2"),
        (b"property float f_dc_0\n", b"property uchar red\n", "misses the properties f_dc_0"),
    ],
)
def test_the_sentence_says_what_to_do(file: Path, old: bytes, new: bytes, sentence: str) -> None:
    replace_bytes(file, old, new)
    with pytest.raises(MalformedFileError, match=sentence) as refused:
        read_gaussians(file)
    assert "export the Gaussians again as binary 3DGS PLY" in str(refused.value)


def test_doubles_beyond_float(tmp_path: Path) -> None:
    g = make_gaussians(degree=0)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    path = tmp_path / "a.ply"
    write_foreign(path, g, [(name, "double") for name in names])
    data = bytearray(path.read_bytes())
    start = len(data) - 17 * 8 * len(names)
    data[start + 2 * 8 * len(names) : start + 2 * 8 * len(names) + 8] = np.float64(1e300).tobytes()
    path.write_bytes(data)
    with pytest.raises(NonFiniteError, match="Gaussian 2 has x"):
        read_gaussians(path)


def test_more_than_one_block(tmp_path: Path) -> None:
    """Rows keep their order across blocks, and an error names the row in the file."""
    want = make_gaussians(BLOCK + 100, degree=1)
    write_gaussians(tmp_path / "a.ply", want)
    np.testing.assert_array_equal(read_gaussians(tmp_path / "a.ply").sh, want.sh)
    data = bytearray((tmp_path / "a.ply").read_bytes())
    width = 4 * (17 + 9)
    at = len(data) - 40 * width
    data[at : at + 4] = np.float32("nan").tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(NonFiniteError, match=f"Gaussian {BLOCK + 60} has x"):
        read_gaussians(tmp_path / "a.ply")


def test_too_many(file: Path) -> None:
    with pytest.raises(LimitExceededError, match="17 Gaussians, limit 16"):
        read_gaussians(file, max_gaussians=16)
