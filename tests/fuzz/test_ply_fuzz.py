"""The PLY reader on files that are damaged, hostile or merely unusual.

Either the file is refused with one of our errors, or the Gaussians are what an independent reading
of the same bytes gives; nothing else may come out, and no more memory is taken than the file is long.
"""

import os
import tracemalloc
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from aomgen.core.gaussians import Gaussians
from aomgen.errors import InputError, LimitExceededError, MalformedFileError, NonFiniteError
from aomgen.io.ply import MAX_GAUSSIANS, MAX_HEADER_BYTES, read_gaussians

# The same files on every run; a failure prints the file as Python.
FUZZ = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
KINDS = {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8", "uchar": "u1", "short": "i2"}
KINDS |= {"char": "i1", "ushort": "u2", "int": "i4", "uint": "u4", "int16": "i2", "uint8": "u1"}
REQUIRED = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
REQUIRED += ["rot_0", "rot_1", "rot_2", "rot_3"]


@dataclass(frozen=True)
class Ply:
    """A PLY file as its parts: what a writer of any taste might produce."""

    order: str
    count: int
    properties: tuple[tuple[str, str], ...]
    remarks: tuple[str, ...]
    newline: str
    seed: int

    @property
    def dtype(self) -> np.dtype:
        sign = "<" if self.order == "little" else ">"
        return np.dtype([(name, sign + KINDS[kind]) for name, kind in self.properties])

    def table(self) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        table = np.empty(self.count, self.dtype)
        for name in table.dtype.names:
            is_unsigned = table.dtype[name].kind == "u"
            table[name] = rng.integers(1 if name == "rot_0" else 0 if is_unsigned else -5, 6, self.count)
        return table

    def header(self) -> bytes:
        lines = ["ply", f"format binary_{self.order}_endian 1.0", *self.remarks]
        lines += [
            f"element vertex {self.count}",
            *[f"property {kind} {name}" for name, kind in self.properties],
        ]
        return (self.newline.join([*lines, "end_header"]) + self.newline).encode()

    def data(self) -> bytes:
        return self.header() + self.table().tobytes()


@st.composite
def plys(draw: st.DrawFn) -> Ply:
    """Every layout the reader promises to take: any order and type of properties, unknown ones in between."""
    names = REQUIRED + [f"f_rest_{i}" for i in range(draw(st.sampled_from([0, 9, 24, 45])))]
    names += draw(
        st.sampled_from([[], ["nx", "ny", "nz"], ["confidence"], ["end_header_1", "f_dc", "element"]])
    )
    kinds = st.sampled_from(sorted(KINDS))
    remark = st.sampled_from(
        ["comment", "obj_info x", "comment end_header", "comment property list", "", "comment \f x"]
    )
    return Ply(
        order=draw(st.sampled_from(["little", "big"])),
        count=draw(st.integers(0, 5)),
        properties=tuple((name, draw(kinds)) for name in draw(st.permutations(names))),
        remarks=tuple(draw(st.lists(remark, max_size=3))),
        newline=draw(st.sampled_from(["\n", "\r\n"])),
        seed=draw(st.integers(0, 2**31)),
    )


def plain(count: int = 3) -> Ply:
    properties = tuple((name, "float") for name in [*REQUIRED, *(f"f_rest_{i}" for i in range(9))])
    return Ply(
        order="little", count=count, properties=properties, remarks=("comment x",), newline="\n", seed=1
    )


def check_sound(gaussians: Gaussians) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.isfinite(getattr(gaussians, name)).all(), name
    np.testing.assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-5)
    assert (gaussians.scales > 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()


def read_or_refuse(folder: Path, data: bytes) -> Gaussians | None:
    """What was read, or None where it was refused with a sentence that names the file."""
    path = folder / "fuzzed.ply"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            gaussians = read_gaussians(path)
        except InputError as error:
            refusal = str(error)
        else:
            check_sound(gaussians)
            return gaussians
    assert "fuzzed.ply: " in refusal
    assert len(refusal) < 2000
    return None


@FUZZ
@given(ply=plys())
def test_every_layout_is_read_right(tmp_path: Path, ply: Ply) -> None:
    have, table = read_or_refuse(tmp_path, ply.data()), ply.table()
    assert have is not None
    assert len(have) == ply.count

    def columns(*names: str) -> np.ndarray:
        return np.array([table[name].astype(float) for name in names]).T

    np.testing.assert_allclose(have.means, columns("x", "y", "z"))
    np.testing.assert_allclose(have.scales, np.exp(columns("scale_0", "scale_1", "scale_2")), rtol=1e-5)
    np.testing.assert_allclose(have.opacities, 1 / (1 + np.exp(-columns("opacity")[:, 0])), rtol=1e-5)
    np.testing.assert_array_equal(have.sh[:, 0], columns("f_dc_0", "f_dc_1", "f_dc_2"))
    rest = have.sh.shape[1] - 1
    for channel in range(3):
        for k in range(rest):
            np.testing.assert_array_equal(have.sh[:, 1 + k, channel], table[f"f_rest_{channel * rest + k}"])
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    np.testing.assert_allclose(have.quats * np.linalg.norm(quats, axis=1, keepdims=True), quats, atol=1e-4)


def cut(data: bytes, at: int, size: int, junk: bytes) -> bytes:
    return data[:at]


def remove(data: bytes, at: int, size: int, junk: bytes) -> bytes:
    return data[:at] + data[at + size :]


def repeat(data: bytes, at: int, size: int, junk: bytes) -> bytes:
    return data[: at + size] + data[at:]


def insert(data: bytes, at: int, size: int, junk: bytes) -> bytes:
    return data[:at] + junk + data[at:]


def overwrite(data: bytes, at: int, size: int, junk: bytes) -> bytes:
    return data[:at] + junk + data[at + len(junk) :]


DAMAGE = st.tuples(
    st.sampled_from([cut, remove, repeat, insert, overwrite]),
    st.floats(0, 1),
    st.integers(1, 40),
    st.one_of(
        st.binary(min_size=1, max_size=8),
        st.sampled_from(
            [b"\n", b"\r", b"\0", b"9", b"end_header\n", b"property float x\n", b"\xff\xff\x7f\xff"]
        ),
        st.sampled_from(
            [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\1\0\x80\x7f", b"\0\0\0\0"]
        ),
    ),
)


@settings(FUZZ, max_examples=600)
@given(
    ply=st.one_of(st.just(plain()), plys()),
    in_header=st.booleans(),
    damages=st.lists(DAMAGE, min_size=1, max_size=4),
)
def test_damaged_bytes(tmp_path: Path, ply: Ply, in_header: bool, damages: list) -> None:
    data = ply.data()
    for damage, where, size, junk in damages:
        end = len(ply.header()) if in_header else len(data)
        data = damage(data, int(where * min(end, len(data))), size, junk)
    read_or_refuse(tmp_path, data)


LINES = st.one_of(
    st.sampled_from(plain().header().decode().splitlines()[1:]),
    st.sampled_from(
        [
            "format ascii 1.0",
            "format binary_big_endian 1.0",
            "format binary_little_endian 2.0",
            "format",
            "element vertex 0",
            "element vertex -3",
            "element vertex 3.0",
            "element vertex 1e3",
            "element vertex 1000000000000",
            "element vertex 18446744073709551619",
            "element vertex 3 3",
            "element face 2",
            "property list uchar int vertex_indices",
            "property float",
            "property half opacity",
            "property float x",
            "property double f_rest_9",
            "comment element vertex 9",
            "end_header",
            "ply",
        ]
    ),
    st.text(st.characters(codec="latin-1"), max_size=30),
)


@FUZZ
@given(
    lines=st.lists(LINES, max_size=4),
    at=st.lists(st.integers(0, 30), min_size=4, max_size=4),
    replace=st.booleans(),
)
def test_strange_header_lines(tmp_path: Path, lines: list[str], at: list[int], replace: bool) -> None:
    header = plain().header().decode().splitlines()
    for line, place in zip(lines, at, strict=False):
        header[place : place + replace] = [line]
    data = ("\n".join(header) + "\n").encode("latin-1") + plain().table().tobytes()
    have = read_or_refuse(tmp_path, data)
    if have is not None:
        assert len(have) in (0, 3)


@FUZZ
@given(data=st.binary(max_size=300), start=st.sampled_from([b"", b"ply\n", b"ply\r\n", b"ply\nend_header\n"]))
def test_noise(tmp_path: Path, data: bytes, start: bytes) -> None:
    assert read_or_refuse(tmp_path, start + data) is None


@FUZZ
@given(
    values=st.lists(st.integers(0, 2**64 - 1), min_size=23, max_size=23),
    kind=st.sampled_from(["float", "double"]),
)
def test_any_bits_as_numbers(tmp_path: Path, values: list[int], kind: str) -> None:
    """All bit patterns of both float types, so NaNs of every kind, infinities and denormals."""
    names = [name for name, _ in plain().properties]
    ply = Ply("little", 1, tuple((name, kind) for name in names), (), "\n", 0)
    raw = np.array(values, "<u8").astype("<u8" if kind == "double" else "<u4").tobytes()
    read_or_refuse(tmp_path, ply.header() + raw)


@pytest.mark.parametrize(
    ("name", "value"),
    [("x", 1e300), ("f_rest_3", -1e39), ("rot_2", 1e200), ("scale_1", 1e5), ("opacity", np.inf)],
)
def test_doubles_beyond_single_precision_are_refused(tmp_path: Path, name: str, value: float) -> None:
    ply = plain()
    ply = Ply("little", 3, tuple((n, "double") for n, _ in ply.properties), (), "\n", 1)
    table = ply.table()
    table[name][1] = value
    path = tmp_path / "a.ply"
    path.write_bytes(ply.header() + table.tobytes())
    with pytest.raises(NonFiniteError):
        read_gaussians(path)


def peak_bytes(path: Path) -> int:
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            read_gaussians(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("count", [4, 10**6, MAX_GAUSSIANS, MAX_GAUSSIANS + 1, 10**12, 10**15 - 1])
def test_a_claimed_count_allocates_nothing(tmp_path: Path, count: int) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(plain().data().replace(b"vertex 3", f"vertex {count}".encode()))
    assert peak_bytes(path) < 1 << 20


def test_a_sparse_file_as_long_as_it_claims_is_refused_by_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = plain(MAX_GAUSSIANS + 1).header()
    path.write_bytes(header)
    with path.open("ab") as file:
        file.truncate(len(header) + (MAX_GAUSSIANS + 1) * plain().dtype.itemsize)
    assert peak_bytes(path) < 1 << 20
    with pytest.raises(LimitExceededError, match="10000001 Gaussians"):
        read_gaussians(path)


@pytest.mark.parametrize("line", [b"comment x\n", b"property float p\n", b"\n", b"comment "])
def test_an_endless_header_is_not_read_to_its_end(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + line * (40 * MAX_HEADER_BYTES // len(line)))
    assert peak_bytes(path) < 1 << 20
    with pytest.raises(LimitExceededError, match="header"):
        read_gaussians(path)


def test_a_file_that_shrinks_while_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(plain().data())
    whole = np.fromfile
    monkeypatch.setattr(np, "fromfile", lambda *a, **k: whole(*a, **k)[:-1])
    with pytest.raises(MalformedFileError, match="shorter"):
        read_gaussians(path)


def test_a_folder_a_pipe_and_a_link_to_nothing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "link.ply").symlink_to("nothing")
    for name in ("folder", "pipe", "link"):
        with pytest.raises(InputError, match=f"{name}.ply: is missing"):
            read_gaussians(tmp_path / f"{name}.ply")


@FUZZ
@given(ply=plys(), length=st.floats(0, 1, exclude_max=True))
def test_every_truncation_is_refused(tmp_path: Path, ply: Ply, length: float) -> None:
    assume(ply.count > 0)
    data = ply.data()
    assert read_or_refuse(tmp_path, data[: int(length * len(data))]) is None
