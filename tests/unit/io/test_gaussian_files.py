"""`.splat` files: the layout, the rounding, the choice by suffix, and files that must be refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.errors import (
    ConfigError,
    InputError,
    LimitExceededError,
    MalformedFileError,
    MissingFileError,
    NonFiniteError,
)
from aomgen.io import gaussian_files, usd
from aomgen.io.gaussian_files import read_splat, write_splat


def record(
    position=(1, 2, 3), scale=(0.1, 0.2, 0.3), rgba=(255, 0, 51, 204), quat=(128, 255, 128, 128)
) -> bytes:
    return struct.pack("<6f8B", *position, *scale, *rgba, *quat)


def make_gaussians(count: int = 50, degree: int = 0) -> Gaussians:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        opacities=rng.uniform(0, 1, count),
        sh=rng.uniform(-1.7, 1.7, (count, (degree + 1) ** 2, 3)),
    )


def test_layout(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(record() + record(position=(4, 5, 6), quat=(192, 192, 64, 64)))
    g = read_splat(path)
    np.testing.assert_array_equal(g.means, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(g.scales, [[0.1, 0.2, 0.3]] * 2)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(g.opacities, 0.8)
    np.testing.assert_allclose(g.quats, [[0, 1, 0, 0], [0.5, 0.5, -0.5, -0.5]])
    assert g.sh_degree == 0


def test_round_trip_within_rounding(tmp_path: Path) -> None:
    want = make_gaussians(degree=2)
    write_splat(tmp_path / "a.splat", want)
    have = read_splat(tmp_path / "a.splat")
    np.testing.assert_array_equal(have.means, want.means)
    np.testing.assert_array_equal(have.scales, want.scales)
    np.testing.assert_allclose(have.opacities, want.opacities, atol=0.501 / 255)
    np.testing.assert_allclose(have.sh[:, 0] * SH_C0, want.sh[:, 0] * SH_C0, atol=0.501 / 255)
    turned_deg = 2 * np.degrees(np.arccos(np.minimum(1, np.abs((have.quats * want.quats).sum(1)))))
    assert turned_deg.max() < 1.2
    assert have.sh_degree == 0


def test_colors_are_cut(tmp_path: Path) -> None:
    g = make_gaussians(2).with_sh([[[9, -9, 0]]] * 2)
    write_splat(tmp_path / "a.splat", g)
    np.testing.assert_allclose(
        0.5 + SH_C0 * read_splat(tmp_path / "a.splat").sh[0, 0], [1, 0, 0.5], atol=0.002
    )


def test_no_gaussians(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(b"")
    assert len(read_splat(tmp_path / "a.splat")) == 0


@pytest.mark.parametrize(
    ("data", "error", "sentence"),
    [
        (record() + b"x", MalformedFileError, "33 bytes, no multiple of 32"),
        (record()[:-1], MalformedFileError, "31 bytes"),
        (record() + record(position=(0, np.nan, 0)), NonFiniteError, "Gaussian 1 has means"),
        (record() + record(scale=(0, np.inf, 0)), NonFiniteError, "Gaussian 1 has scales"),
        (record() + record(scale=(1, -1, 1)), MalformedFileError, "Gaussian 1 has the negative scales"),
        (record() + record(quat=(128,) * 4), NonFiniteError, "Gaussian 1 has a rotation of length zero"),
        (record() * 4, LimitExceededError, "4 Gaussians, limit 3"),
    ],
)
def test_refused(tmp_path: Path, data: bytes, error: type[InputError], sentence: str) -> None:
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(error, match=sentence):
        read_splat(tmp_path / "a.splat", max_gaussians=3)


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        read_splat(tmp_path / "a.splat")


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.PLY"])
def test_the_suffix_chooses(tmp_path: Path, name: str) -> None:
    want = make_gaussians()
    gaussian_files.write_gaussians(tmp_path / name, want)
    np.testing.assert_array_equal(gaussian_files.read_gaussians(tmp_path / name).means, want.means)
    with pytest.raises(LimitExceededError):
        gaussian_files.read_gaussians(tmp_path / name, max_gaussians=49)


@pytest.mark.parametrize(
    ("name", "value"), [("means", np.nan), ("sh", np.inf), ("quats", 0), ("scales", np.nan)]
)
@pytest.mark.parametrize("file", ["a.ply", "a.splat", "a.usdc"])
def test_writers_refuse_what_readers_would(tmp_path: Path, file: str, name: str, value: float) -> None:
    arrays = {key: getattr(make_gaussians(), key).copy() for key in Gaussians.__dataclass_fields__}
    arrays[name][7] = value
    broken = gaussians_of(**arrays)
    write = usd.write_gaussians if file == "a.usdc" else gaussian_files.write_gaussians
    with pytest.raises(NonFiniteError, match="Gaussian 7"):
        write(tmp_path / file, broken)
    assert not list(tmp_path.iterdir())


def test_unknown_suffix(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'\.sog', \.ply, \.splat, \.spz, \.glb can be read"):
        gaussian_files.read_gaussians(tmp_path / "a.sog")
    with pytest.raises(ConfigError, match="written"):
        gaussian_files.write_gaussians(tmp_path / "a.sog", make_gaussians())


@settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.binary(max_size=200), changes=st.lists(st.tuples(st.integers(0, 95), st.integers(0, 255))))
def test_any_bytes(tmp_path: Path, data: bytes, changes: list[tuple[int, int]]) -> None:
    """Refused with one of our errors, or Gaussians that can be drawn and written again."""
    damaged = bytearray(record() * 3)
    for at, value in changes:
        damaged[at] = value
    for content in (data, bytes(damaged)):
        (tmp_path / "a.splat").write_bytes(content)
        try:
            g = read_splat(tmp_path / "a.splat")
        except InputError:
            continue
        assert len(g) == len(content) // 32
        np.testing.assert_allclose(np.linalg.norm(g.quats, axis=1), 1, atol=1e-6)
        assert np.isfinite(g.means).all()
        assert (g.scales >= 0).all()
        write_splat(tmp_path / "b.splat", g)
        np.testing.assert_array_equal(read_splat(tmp_path / "b.splat").means, g.means)
