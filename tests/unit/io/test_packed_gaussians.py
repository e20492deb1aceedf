"""`.spz` and `.glb` files of Gaussians: the layout, the rounding, and damaged files, which are refused or read right."""

import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aomgen.core.gaussians import SH_C0, Gaussians, gaussians_of
from aomgen.errors import InputError, LimitExceededError, MalformedFileError, NonFiniteError
from aomgen.io.gaussian_files import read_gaussians, write_gaussians

FUZZ = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
SUFFIXES = (".spz", ".glb")


def make_gaussians(count: int = 60, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-4, 1, (count, 3))),
        opacities=rng.uniform(0, 1, count),
        sh=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
    )


def turns_between(a: Gaussians, b: Gaussians) -> np.ndarray:
    """Angles (N,) between rotations, [rad]."""
    products = np.abs((a.quats.astype(np.float64) * b.quats).sum(1))
    return 2 * np.arccos(np.clip(products, 0, 1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_glb_is_exact(tmp_path: Path, degree: int) -> None:
    wanted = make_gaussians(degree=degree)
    write_gaussians(tmp_path / "a.glb", wanted)
    found = read_gaussians(tmp_path / "a.glb")
    for name in ("means", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    assert turns_between(found, wanted).max() < 1e-3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_rounds_as_it_says(tmp_path: Path, degree: int) -> None:
    wanted = make_gaussians(degree=degree)
    write_gaussians(tmp_path / "a.spz", wanted)
    found = read_gaussians(tmp_path / "a.spz")
    assert np.abs(found.means - wanted.means).max() <= 1.01 / (1 << 17)
    assert np.abs(np.log(found.scales / wanted.scales)).max() <= 1.01 / 32
    assert np.abs(found.opacities - wanted.opacities).max() <= 1.01 / 510
    assert np.abs(found.sh[:, 0] - wanted.sh[:, 0]).max() <= 1.01 / (510 * 0.15)
    assert np.abs(found.sh[:, 1:] - wanted.sh[:, 1:]).max(initial=0) <= 1.01 / 256
    assert turns_between(found, wanted).max() <= np.deg2rad(0.3)


def test_spz_keeps_a_distant_background(tmp_path: Path) -> None:
    near = make_gaussians()
    far = gaussians_of(means=1000 * near.means, quats=near.quats, scales=near.scales, opacities=near.opacities, sh=near.sh)  # fmt: skip
    write_gaussians(tmp_path / "a.spz", far)
    assert np.abs(read_gaussians(tmp_path / "a.spz").means - far.means).max() <= 3e-4
    farther = gaussians_of(means=1e8 * near.means, quats=near.quats, scales=near.scales, opacities=near.opacities, sh=near.sh)  # fmt: skip
    with pytest.raises(LimitExceededError, match="units away"):
        write_gaussians(tmp_path / "b.spz", farther)
    assert not (tmp_path / "b.spz").exists()


def test_layout_of_spz(tmp_path: Path) -> None:
    """One Gaussian by hand, as the format describes it."""
    one = gaussians_of(
        means=[[1.0, -2.0, 0.5]], quats=[[0.5, 0.5, -0.5, 0.5]], scales=[[np.exp(-4.0)] * 3], opacities=[1.0], sh=np.zeros((1, 1, 3))
    )  # fmt: skip
    write_gaussians(tmp_path / "a.spz", one)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, fraction, flags, _ = struct.unpack("<4s2I4B", data[:16])
    assert (magic, version, count, degree, fraction, flags) == (b"NGSP", 3, 1, 0, 16, 0)
    positions = [int.from_bytes(data[16 + 3 * k : 19 + 3 * k], "little", signed=True) for k in range(3)]
    assert positions == [1 << 16, -(2 << 16), 1 << 15]
    assert data[25] == 255
    assert list(data[26:29]) == [128, 128, 128]
    assert list(data[29:32]) == [96, 96, 96]
    # The first of the equal components of xyzw is the largest; y has another sign than x.
    packed = int.from_bytes(data[32:36], "little")
    half = round(511 * 0.5 * np.sqrt(2))
    assert packed == half << 20 | 1 << 29 | half << 10 | half
    assert len(data) == 36


def test_header_of_glb(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.glb", make_gaussians(5, 1))
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack("<4s3I4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    described = json.loads(data[20 : 20 + size])
    (primitive,) = described["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    names = {name.removeprefix("KHR_gaussian_splatting:") for name in primitive["attributes"]}
    harmonics = {"SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{k}" for k in range(3))}
    assert names == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY"} | harmonics
    assert {item["count"] for item in described["accessors"]} == {5}
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_gaussians(tmp_path: Path, suffix: str) -> None:
    write_gaussians(tmp_path / f"a{suffix}", make_gaussians(0))
    assert len(read_gaussians(tmp_path / f"a{suffix}")) == 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_too_many_are_refused(tmp_path: Path, suffix: str) -> None:
    write_gaussians(tmp_path / f"a{suffix}", make_gaussians(20))
    with pytest.raises(LimitExceededError, match="20 Gaussians, limit 19"):
        read_gaussians(tmp_path / f"a{suffix}", max_gaussians=19)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_not_finite_is_not_written(tmp_path: Path, suffix: str) -> None:
    wrong = make_gaussians()
    means = np.array(wrong.means)
    means[7, 1] = np.nan
    with pytest.raises(NonFiniteError, match="Gaussian 7"):
        write_gaussians(tmp_path / f"a{suffix}", gaussians_of(means=means, quats=wrong.quats, scales=wrong.scales, opacities=wrong.opacities, sh=wrong.sh))  # fmt: skip
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"glTF", b"NGSP", b"\x1f\x8b\x08", b"x" * 100])
def test_other_files_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises(MalformedFileError):
        read_gaussians(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
@FUZZ
@given(damage=st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 255)), min_size=1, max_size=4), cut=st.integers(0, 4000))  # fmt: skip
def test_damaged_files(tmp_path: Path, suffix: str, damage: list[tuple[int, int]], cut: int) -> None:
    """One of our errors, or Gaussians that any renderer takes."""
    whole = tmp_path / f"whole{suffix}"
    if not whole.exists():
        write_gaussians(whole, make_gaussians(8, 1))
    data = bytearray(whole.read_bytes())
    if suffix == ".spz":
        data = bytearray(gzip.decompress(data))
    for place, value in damage:
        data[place % len(data)] = value
    data = data[: len(data) - cut % 50 if cut % 3 == 0 else len(data)]
    file = tmp_path / f"damaged{suffix}"
    file.write_bytes(gzip.compress(data) if suffix == ".spz" else data)
    try:
        found = read_gaussians(file, max_gaussians=10_000)
    except InputError:
        return
    assert np.isfinite(found.means).all()
    assert np.isfinite(found.sh * SH_C0).all()
    assert (found.scales >= 0).all()
